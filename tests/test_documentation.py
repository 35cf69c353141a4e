"""The documentation is true: its code runs, its links lead somewhere, its lists are complete."""

import json
import re
import runpy
import shlex
import subprocess
import urllib.request
from glob import glob
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sme_registry import load, make
from sme_registry.spec import NoiseSpec, ObservationSpec, SafetySpec, ShapingSpec, SMESpec
from sme_registry.studies.executors import InProcess, Processes
from sme_registry.task.certificate import certify

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted(ROOT.glob("docs/tutorials/*.ipynb"))
PAGES = [*sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]), *TUTORIALS]


def cells(tutorial, kind):
    """The sources of a notebook's cells of a kind, "code" or "markdown"."""
    notebook = json.loads(tutorial.read_text(encoding="utf-8"))
    return ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == kind]


@pytest.mark.parametrize(
    ("name", "shorter"),
    [
        (
            "README",
            {
                "--steps 20000": "--steps 64 --set n_steps=64",
                "-n 20000 --seeds 3": "-n 64 --set PPO.n_steps=64 --protocol quick-v1 --seeds 1",
            },
        ),
        ("tasks", {}),
        (
            "streams",
            {
                "20_000": "100",
                "-a PPO --out": "--set n_steps=100 --set batch_size=50 -a PPO --out",
                "train Switch5": "train mine.json",
                "visit-*.zip Switch5": "visit-*.zip mine.json",
            },
        ),
        ("teams", {"--steps 40000": "-n 64 --num-envs 2 --set n_steps=64"}),
        ("safety_and_observation", {"-n 20000": "-n 64 --set n_steps=64"}),
        ("offline", {"--transitions 50000": "-n 1000 --protocol quick-v1", "-n 20000": "-n 20"}),
    ],
)
@pytest.mark.usefixtures("in_process")
def test_a_guide_works_from_top_to_bottom(name, shorter, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    folder = ROOT if name == "README" else ROOT / "docs" / "guides"
    work_through((folder / f"{name}.md").read_text(), shorter)


def work_through(page, shorter):
    """Run a page's Python and commands in order, with some of its text replaced."""
    for full, short in shorter.items():
        assert full in page
        page = page.replace(full, short)
    namespace = {"__name__": "page"}
    for language, block in re.findall(r"^```(python|sh)\n(.*?)^```", page, re.M | re.S):
        if language == "python":
            exec(compile(block, "page", "exec"), namespace)
        else:
            for line in block.replace("\\\n", "").splitlines():
                run(*line.split(maxsplit=1))


@pytest.mark.parametrize(
    "page",
    [f"docs/guides/{name}.md" for name in ("training", "studies")],
)
def test_the_python_of_a_page_runs_from_top_to_bottom(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.M | re.S)
    assert blocks
    namespace = {"__name__": "page"}
    for block in blocks:
        exec(compile(block, page, "exec"), namespace)


@pytest.fixture
def in_process(monkeypatch):
    """Cells run in this process: a page's studies are small, and a process takes two seconds."""

    def here(executor, jobs, progress):
        return InProcess(None, executor._run, executor._keep_models).map(jobs, progress)

    monkeypatch.setattr(Processes, "map", here)


@pytest.mark.parametrize(
    ("name", "packages", "shorter"),
    [
        (
            "own_agents",
            "torch matplotlib onnx onnxruntime nacl",
            {
                "STEPS = 5_000": "STEPS = 200",
                'catalogue.find(SuiteFile, "smoke")': 'SuiteFile.read("two.json")',
                "init board --practice": "init board --practice --suite two.json",
            },
        ),
        (
            "sweep_figure",
            "torch pandas IPython",
            {
                "--agents jax": "",
                "k=1,5,20": "k=1,20",
                "-n 16000": "-n 500",
                "--seeds 5": "--seeds 1",
            },
        ),
        ("offline_data", "torch minari matplotlib", {"20_000": "2_000", "steps=3_000": "steps=50"}),
        ("teams", "stable_baselines3 IPython", {"--steps 4096": "--steps 2048"}),
        (
            "continual_stream",
            "torch pandas IPython",
            {
                "--agents jax": "",
                "5_000": "500",
                "--seeds 5 --evaluations 20": "--seeds 1 --evaluations 2",
            },
        ),
    ],
)
@pytest.mark.usefixtures("in_process")
def test_a_tutorial_works_from_top_to_bottom(name, packages, shorter, tmp_path, monkeypatch):
    for package in packages.split():
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    code = cells(ROOT / "docs" / "tutorials" / f"{name}.ipynb", "code")[1:]  # without installing
    run("sme", "new two.json -t Default -t Plane1 --instances 1")
    for full, short in shorter.items():
        assert any(full in cell for cell in code)
        code = [cell.replace(full, short) for cell in code]
    namespace = {"__name__": "page"}
    for cell in code:
        if not cell.startswith("%%sh -e\n"):
            exec(compile(cell, "page", "exec"), namespace)
        else:
            for line in cell.replace("\\\n", "").splitlines()[1:]:
                program, _, arguments = line.partition(" ")
                if program in ("sme", "sme-leaderboard"):
                    output = run(program, arguments)
                    assert not arguments.startswith("rank") or "My DDPG" in output
                else:
                    subprocess.run(shlex.split(line), check=True)


@pytest.mark.usefixtures("in_process")
def test_the_pages_on_boards_lead_from_an_own_suite_over_a_served_board_to_a_rank(
    tmp_path, monkeypatch
):
    for package in ("torch", "onnx", "onnxruntime", "fastapi", "httpx"):
        pytest.importorskip(package)
    from tests.leaderboard.serving import serving

    monkeypatch.chdir(tmp_path)
    create, score, verify = shell("hosting")
    submit, read, verify_copy = shell("leaderboard")
    play(create)
    with serving("board") as url:
        play(submit, url)  # a served board scores by itself, and here the page's next command
        play(score, url)
        assert re.search(r"^ *1  PPO", play(read, url), re.M)
        play(verify_copy.replace("--rescore 5", ""), url)
    play(verify.replace("--rescore 1", ""))
    assert Path("public/index.html").exists()


def shell(page):
    """The blocks of commands of a guide."""
    text = (ROOT / "docs" / "guides" / f"{page}.md").read_text()
    return re.findall(r"^```sh\n(.*?)^```", text, re.M | re.S)


def play(block, url=""):
    """Run the commands of a block, with little training; the last one's output."""
    short = {"-n 20000": "-n 64 --seeds 2 --set n_steps=64 --protocol quick-v1"}
    for full, other in {**short, "https://board.example": url}.items():
        block = block.replace(full, other)
    for program, _, command in (line.partition(" ") for line in block.splitlines()):
        if program == "curl":
            address = command.removeprefix("-O ")
            with urllib.request.urlopen(address) as answer:
                Path(address.rpartition("/")[2]).write_bytes(answer.read())
        else:
            output = run(program, command)
    return output


def run(program, command):
    """The output of a command of the documentation, which must succeed; with a key of its own."""
    from leaderboard.cli import app as leaderboard
    from sme_registry.cli import app as sme

    words = shlex.split(command, comments=True)
    arguments = [path for word in words for path in sorted(glob(word)) or [word]]
    short = ["--protocol", "quick-v1"] if arguments[0] in ("train", "evaluate") else []
    arguments += [] if "--protocol" in arguments or "--data" in arguments else short
    key = ["--key", "my.key"] if arguments[0] == "submit" else []
    key = key if program == "sme-leaderboard" else []
    result = CliRunner().invoke(sme if program == "sme" else leaderboard, [*arguments, *key])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_leads_to_a_file(page):
    text = "\n".join(cells(page, "markdown")) if page in TUTORIALS else page.read_text()
    links = re.findall(r"\]\((?!https?:)([^)#]+)", text)
    missing = [link for link in links if not (page.parent / link).exists()]
    assert not missing


GENERATED = runpy.run_path(str(ROOT / "docs" / "generate.py"))["pages"]()


def test_generated_pages_are_what_make_docs_writes():
    folder = ROOT / "docs" / "reference" / "generated"
    written = {path.name: path.read_text() for path in folder.iterdir()}
    assert written == GENERATED, "run `make docs`"


def test_the_example_of_the_readme_prints_what_stands_below_it(capsys):
    readme = (ROOT / "README.md").read_text()
    code, output = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", readme, re.S).groups()
    exec(compile(code, "README.md", "exec"), {"__name__": "page"})
    assert capsys.readouterr().out == output
    assert len(readme.split()) <= 900


def test_the_function_of_the_readme_acts_on_every_level_of_a_profile():
    source = re.search(
        r"```python\n([^`]*?def train.*?)```", (ROOT / "README.md").read_text(), re.S
    )
    namespace = {"__name__": "page"}
    exec(compile(source[1], "README.md", "exec"), namespace)
    for name in ("Default", "ActionDim16", "StateDim64"):
        env = make(name)
        policy = namespace["train"](env, 100, 0)
        observations = np.zeros((3, *env.observation_space.shape))
        assert policy(observations).shape == (3, *env.action_space.shape), name


def test_the_table_of_fields_has_every_field_its_default_and_its_meaning():
    table = re.findall(r"^\| `(\w+)` \| .* \| (.*?) \| (.*?) \|$", tasks_page(), re.M)
    fields = {
        name: field
        for name, field in SMESpec.model_fields.items()
        if name not in ("schema_version", "team", "safety", "observation", "shaping", "noise")
    }
    assert {name: number(default.strip("`")) for name, default, _ in table} == {
        name: number(str(field.default)) for name, field in fields.items()
    }
    for name, _, meaning in table:
        assert f"{meaning.partition(';')[0]}." == fields[name].description


def test_the_tables_of_blocks_have_every_field():
    safety = (ROOT / "docs" / "guides" / "safety_and_observation.md").read_text()
    documented = re.findall(r"^\| `(\w+\.\w+)` \|", tasks_page() + safety, re.M)
    kinds = {
        "shaping": ShapingSpec,
        "noise": NoiseSpec,
        "safety": SafetySpec,
        "observation": ObservationSpec,
    }
    fields = [f"{name}.{field}" for name, kind in kinds.items() for field in kind.model_fields]
    assert documented == fields


def test_the_checks_of_the_page_are_those_of_a_certificate(tmp_path):
    from sme_registry.cli import app as sme

    page = (ROOT / "docs" / "guides" / "safety_and_observation.md").read_text()
    block = page.split("## One task from spec to agent")[1]
    command = block.split("```")[1].replace("\\\n", "").splitlines()[1]
    arguments = shlex.split(command)[1:]
    arguments[1] = str(tmp_path / arguments[1])
    assert CliRunner().invoke(sme, arguments).exit_code == 0
    checks = {check.name: check for check in certify(load(arguments[1])).checks}
    table = re.findall(r"^\| `(\w+)`: .* \| ([\d.]+) \|$", block, re.M)
    assert len(table) == 6
    for name, value in table:
        assert checks[name].outcome == "passed"
        assert float(value) == pytest.approx(checks[name].value, rel=0.05)


def tasks_page():
    return (ROOT / "docs" / "guides" / "tasks.md").read_text()


def number(text):
    try:
        return float(text)
    except ValueError:
        return text


def first_column(table):
    return [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]


@pytest.mark.parametrize("package", ["sme_registry", "leaderboard"])
def test_the_map_of_the_code_lists_every_module_of_a_package(package):
    table = (ROOT / "CONTRIBUTING.md").read_text().split(f"`{package}`", 1)[1].split("\n\n")[1]
    listed = set(re.findall(r"`(\w+)`", "\n".join(first_column(table))))
    modules = {path.stem for path in (ROOT / package).glob("[!_]*.py")}
    packages = {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
    assert listed == modules | packages
