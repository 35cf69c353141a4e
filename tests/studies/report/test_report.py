"""`sme study report` writes complete and deterministic files."""

import csv
import re
import shutil
import subprocess
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from sme_registry.errors import OptionError
from sme_registry.io import read_json
from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.report.findings import findings
from sme_registry.studies.report.frames import records
from tests.commands import good, refused
from tests.page import Page
from tests.studies.cells import small_file

pytest.importorskip("matplotlib")

from matplotlib.figure import Figure

from sme_registry import SMESpec
from sme_registry.studies.report.figures import _on_plane
from sme_registry.studies.report.write import write_report

FIGURES = {
    "contrasts-regret", "contrasts-training", "wd-regret", "ood-regret", "regions", "decay",
    "aggregates", "profiles-wd", "profiles-ood", "improvements", "learning-curves-k",
    "differences", "learning-curves-by-class",
    "learning-curves-r_min", "learning-curves-complexity", "learning-curves-several-axes",
}  # fmt: skip


@pytest.fixture(scope="module")
def report(finished, tmp_path_factory):
    """Its folder, in every format but PDF, and its figures by name."""
    folder, figures, save = tmp_path_factory.mktemp("report"), [], Figure.savefig

    def saved(figure, *args, **options):
        save(figure, *args, **options)
        if options["format"] == "png":
            figures.append(figure)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", saved)
        files = write_report(finished, folder, ("html", "png", "csv", "latex"), full=True)
    names = [path.stem for path in files if path.match("figures/*.png")]
    return folder, dict(zip(names, figures, strict=True))


@pytest.fixture(scope="module")
def written(report):
    return report[0]


def test_within_and_out_of_distribution_are_compared_on_one_range(report):
    folder, figures = report
    assert figures.keys() == FIGURES
    files = list((folder / "figures").iterdir())
    assert {path.name for path in files} == {f"{name}.png" for name in FIGURES}
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in files)
    for name in ("contrasts-regret", "aggregates", "differences", "improvements"):
        wd, ood = figures[name].axes[:2]
        assert wd.get_xlim() == ood.get_xlim(), name


def test_the_first_figure_of_two_learners_on_several_axes_is_their_difference(written):
    first = (written / "figure.png").read_bytes()
    assert first == (written / "figures" / "differences.png").read_bytes()


def test_the_command_writes_the_same_files_into_the_study_or_another_folder(
    finished, written, tmp_path
):
    study, out = tmp_path / "study", tmp_path / "elsewhere"
    shutil.copytree(finished, study)
    good("study", "report", study, "--format", "html,pdf,csv,latex", "--full")
    again = {
        path.relative_to(study / "report"): path.read_bytes()
        for path in (study / "report").rglob("*.*")
    }
    figures = {path.stem: again.pop(path) for path in list(again) if path.suffix == ".pdf"}
    assert figures.keys() == FIGURES | {"figure"}
    assert all(content.startswith(b"%PDF") for content in figures.values())
    before = {path.relative_to(written): path.read_bytes() for path in written.rglob("*.*")}
    assert again == {path: content for path, content in before.items() if path.suffix != ".png"}
    good("study", "report", study, "-o", out, "--format", "csv", "--full")
    assert {path.suffix for path in out.rglob("*.*")} == {".csv"}
    assert (out / "tables" / "contrasts.csv").is_file()


def test_the_page_is_whole_loads_nothing_and_says_where_its_numbers_come_from(written, analysis):
    html = (written / "index.html").read_text()
    page = Page(html)
    ids, images = page.values("id"), page.all("img")
    assert len(set(ids)) == len(ids)
    assert all(link.removeprefix("#") in ids for link in page.values("href"))
    assert len(images) == len(FIGURES)
    assert all(image["alt"] for image in images)
    loaded = page.values("src", "data", "srcset")
    assert all(source.startswith("data:image/svg+xml;base64,") for source in loaded)
    assert "default-src 'none'" in html
    assert "<script" not in html
    assert not re.search(r"url\(|@import", html)
    for fact in (
        analysis.file.digest,
        analysis.file.plan.protocol.digest,
        "73 of 75 runs",
        "numpy",
        "Beta on k-25, run 3: failed: ValueError: <b>bad</b>",  # as text, not as a tag
        "Beta on k-25, run 4",
    ):
        assert fact in page.words
    assert "table-levels-wd-regret" in ids
    levels = analysis.tables["levels"][analysis.tables["levels"].metric == "wd_regret"]
    assert all(f"<td>{row.iqm:.2f} [" in html for row in levels.itertuples())


def test_findings_and_every_number_of_the_tables_are_written_as_data(written, analysis):
    document = read_json(written / "findings.json")
    assert (document["schema_version"], document["base"]) == (2, "default")
    assert document["findings"] == records(findings(analysis))
    assert len(analysis.tables["results"]) == 73 * 3
    for path in (written / "tables").glob("*.csv"):
        table = analysis.tables[path.stem]
        numbers = table.select_dtypes("float64")
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        assert list(rows[0] if rows else table) == list(table)
        values = [[float(row[name] or "nan") for name in numbers] for row in rows]
        assert np.array_equal(values, numbers.to_numpy(), equal_nan=True)


def test_latex_tables_are_ascii_and_scaled_to_the_column(written):
    files = list((written / "tables").glob("*.tex"))
    assert len(files) == 21
    for path in files:
        text = path.read_text()
        assert text.isascii(), path
        assert "\\resizebox{\\ifdim\\width>\\linewidth" in text
        columns = re.search(r"begin\{tabular\}\{(l+r*)\}", text)
        assert columns is not None
        rows = [line for line in text.splitlines() if line.endswith(r" \\")]
        assert len(rows) > 1
        for row in rows:
            assert len(re.findall(r"(?<!\\)&", row)) == len(columns[1]) - 1
            assert not re.search(r"(?<!\\)[_%#]", row)


def test_maps_and_explorers_show_the_models_that_were_kept(tmp_path, drawn):
    pytest.importorskip("stable_baselines3")
    ppo = {"name": "PPO", "uses": "PPO", "hyperparameters": {"n_steps": 64, "n_epochs": 1}}
    protocol = {"states_per_region": 50, "epsilons": [1.0]}
    file = small_file(1, [ppo], steps=64, evaluations=1, protocol=protocol)
    ledger = Ledger(tmp_path)
    ledger.write_plan(file)
    (planned,) = file.plan.cells
    model = tmp_path / "model.zip"
    result = run_cell(planned.cell, model_path=model)
    ledger.write(result)
    (page,) = write_report(tmp_path, formats=["html"])
    assert "figure-maps" not in Page(page.read_text()).values("id")
    assert "Run the study with --keep-models" in refused("study", "report", tmp_path, "--explorers")
    ledger.write(result, model.read_bytes())
    page, explorer = write_report(tmp_path, formats=["html"], explorers=True)
    assert "figure-maps" in Page(page.read_text()).values("id")
    assert explorer.parent == page.parent / "explorers"
    assert f'<a href="explorers/{explorer.name}">PPO on small, run 0</a>' in page.read_text()
    assert '"of":"observation"' in explorer.read_text()
    assert '"regions":{"names":["WD"' in explorer.read_text()
    good("diagnose", "--explore", tmp_path, "--cell", result.key, "--out", tmp_path / "one.html")
    assert (tmp_path / "one.html").read_text() == explorer.read_text()
    ledger.model_path(result.key).write_bytes(b"no model")
    assert "figure-maps" not in write_report(tmp_path, formats=["html"])[0].read_text()
    with pytest.raises(OptionError, match="no model of a run on a single task that can be shown"):
        write_report(tmp_path, explorers=True)


def test_no_map_shows_a_policy_that_sees_a_mixed_state():
    def on_plane(spec):
        cells = {"key": SimpleNamespace(cell=SimpleNamespace(spec=spec))}
        return _on_plane(SimpleNamespace(cells=cells, models={"key"}), "key")

    plane = SMESpec(state_dim=2, action_dim=2)
    assert on_plane(plane)
    assert not on_plane(plane.derive(observation={"mixing": "orthogonal"}))
    assert not on_plane(SMESpec())


def test_other_formats_and_folders_without_a_study_or_results_are_refused(finished, tmp_path):
    for formats in (["gif"], []):
        with pytest.raises(OptionError, match="must be of html, png, pdf, csv, latex"):
            write_report(finished, tmp_path, formats)
    assert "holds no study" in refused("study", "report", tmp_path)
    assert not list(tmp_path.iterdir())
    shutil.copy(finished / "plan.json", tmp_path)
    assert "none of its 75 runs has finished" in refused("study", "report", tmp_path)


def test_algorithms_on_classes_without_any_run_are_not_missing(finished, tmp_path, drawn):
    study = tmp_path / "study"
    shutil.copytree(finished, study)
    for planned in Ledger(study).study_file().plan.cells:
        if planned.class_name != "default":
            (study / "cells" / f"{planned.cell.digest[7:]}.json").unlink(missing_ok=True)
    (page,) = write_report(study, formats=["html"])
    text = Page(page.read_text()).words
    assert "15 of 20 runs have finished. The plan has 55 more" in text  # one on k-25 has failed


def test_by_default_a_report_is_a_page_a_figure_and_a_table(finished, tmp_path, drawn):
    files = write_report(finished, tmp_path, ("html", "png", "csv", "latex"))
    names = ["index.html", "figure.png", "table.csv", "table.tex"]
    assert [path.relative_to(tmp_path).as_posix() for path in files] == names
    assert set(pd.read_csv(files[2]).algorithm) == {"Alpha", "Beta", "constant"}


def test_the_table_fits_a_column_of_an_article(finished, tmp_path):
    if not (shutil.which("pdflatex") and subprocess.call(["kpsewhich", "booktabs.sty"]) == 0):
        pytest.skip("needs pdflatex with booktabs")
    (table,) = write_report(finished, tmp_path, ("latex",))
    (tmp_path / "paper.tex").write_text(
        "\\documentclass[twocolumn]{article}\\usepackage{booktabs,graphicx}"
        f"\\begin{{document}}\\input{{{table.name}}}\\end{{document}}\n",
        encoding="ascii",
    )
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    log = (tmp_path / "paper.log").read_text(encoding="latin-1")
    assert done.returncode == 0, log
    assert "Overfull" not in log
    assert "too large" not in log
