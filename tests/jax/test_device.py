"""The process's JAX."""

import pytest

pytest.importorskip("jax")

import jax

from sme_registry.jax.device import CACHE_VARIABLE, compilations, prepare


def test_a_compile_cache_that_cannot_be_written_is_announced(tmp_path, monkeypatch, capsys):
    before = jax.config.jax_compilation_cache_dir
    (tmp_path / "file").write_text("")
    try:
        monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file"))
        prepare()
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{tmp_path / 'file'} cannot be written" in line
        assert jax.config.jax_compilation_cache_dir == before
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "new" / "folder"))
        prepare()
        assert capsys.readouterr().err == ""
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "new" / "folder")
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_what_is_compiled_is_counted_and_what_runs_again_is_not():
    add = jax.jit(lambda x: x + 0.125)
    counts = [compilations()]
    for x in (1.0, 2.0, 3):
        add(x)
        counts.append(compilations())
    before, first, again, other_type = counts
    assert before < first == again < other_type
