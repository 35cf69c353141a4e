"""`sme study report` writes complete and deterministic files."""

from __future__ import annotations

import csv
import dataclasses
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from sme_registry.errors import OptionError
from sme_registry.io import read_json
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.report.analysis import Analysis, analyse
from sme_registry.studies.report.findings import Findings, findings

pytest.importorskip("matplotlib")

from sme_registry.cli.app import app
from sme_registry.studies.report.figures import draw_figures
from sme_registry.studies.report.write import write_report
from tests.geometry import assert_readable

SIGNATURES = {"png": b"\x89PNG", "pdf": b"%PDF"}
FIGURES = {
    "contrasts-regret", "contrasts-training", "wd-regret", "ood-regret", "regions", "decay",
    "aggregates", "profiles-wd", "profiles-ood", "improvements", "learning-curves-k",
    "differences", "learning-curves-by-class",
    "learning-curves-r_min", "learning-curves-complexity", "learning-curves-several-axes",
}  # fmt: skip


class Page(HTMLParser):
    """What a browser would make of the page: tags that close, ids, links, and what it loads."""

    VOID = frozenset({"meta", "img", "br", "link", "input"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.loads: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        if tag not in self.VOID:
            self.open.append(tag)
        if "id" in attributes:
            self.ids.append(str(attributes["id"]))
        if tag == "a":
            self.links.append(str(attributes["href"]))
        if tag == "img":
            self.images.append(attributes)
        sources = {"src", "data", "srcset"} & attributes.keys()
        self.loads += [str(attributes[name]) for name in sources]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.text += data


@pytest.fixture(scope="module")
def written(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(finished, folder)
    return folder


@pytest.fixture(scope="module")
def analysis(finished: Path) -> Analysis:
    ledger = Ledger(finished)
    file = ledger.plan_file()
    assert file is not None
    return analyse(file, ledger.results(), draws=300)


def test_every_figure_is_written_in_every_format(written: Path):
    for ending, signature in SIGNATURES.items():
        files = {path.stem: path for path in (written / "figures").glob(f"*.{ending}")}
        assert set(files) == FIGURES
        assert all(path.read_bytes().startswith(signature) for path in files.values())
    assert len(Page((written / "index.html").read_text()).images) == len(FIGURES)


def test_the_page_is_whole_and_loads_nothing(written: Path):
    text = (written / "index.html").read_text()
    page = Page(text)
    assert page.open == []
    assert len(set(page.ids)) == len(page.ids)
    assert all(link.removeprefix("#") in page.ids for link in page.links)
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.loads)
    assert all(image["alt"] for image in page.images)
    assert "default-src 'none'" in text
    assert "<script" not in text
    assert not re.search(r"url\(|@import", text)


def test_the_page_says_where_its_numbers_come_from(written: Path, analysis: Analysis):
    text = Page((written / "index.html").read_text()).text
    assert analysis.file.digest in text
    assert analysis.file.plan.protocol.digest in text
    assert "73 of 75 runs" in text
    assert "numpy" in text
    assert "Beta on k-25, run 3: failed: ValueError: <b>bad</b>" in text  # as text, not as a tag
    assert "Beta on k-25, run 4" in text


def test_the_findings_are_written_as_data(written: Path, finished: Path):
    ledger = Ledger(finished)
    file = ledger.plan_file()
    assert file is not None
    failures = {key: failure.error for key, failure in ledger.failures().items()}
    read = Findings.from_dict(read_json(written / "findings.json"), "findings.json")
    assert read == findings(analyse(file, ledger.results(), failures))


def test_the_same_results_give_the_same_report(finished: Path, written: Path, tmp_path: Path):
    formats = ("html", "csv", "latex")
    for path in write_report(finished, tmp_path, formats):
        assert path.read_bytes() == (written / path.relative_to(tmp_path)).read_bytes()


def test_the_csv_holds_every_number_of_the_tables(written: Path, finished: Path):
    ledger = Ledger(finished)
    file = ledger.plan_file()
    assert file is not None
    errors = {key: failure.error for key, failure in ledger.failures().items()}
    analysis = analyse(file, ledger.results(), errors)
    for path in (written / "tables").glob("*.csv"):
        table = getattr(analysis, path.stem)
        numbers = table.select_dtypes("float64")
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        assert list(rows[0] if rows else table) == list(table)
        read = [[float(row[name] or "nan") for name in numbers] for row in rows]
        assert np.array_equal(read, numbers.to_numpy(), equal_nan=True)
    assert len(analysis.results) == 73 * 3


def test_latex_tables_are_ascii_and_as_wide_as_they_say(written: Path):
    files = list((written / "tables").glob("*.tex"))
    assert len(files) == 21
    for path in files:
        text = path.read_text()
        assert text.isascii(), path
        columns = re.search(r"X(r*)@\{\}\}$", text, re.MULTILINE)
        assert columns is not None
        rows = [line for line in text.splitlines() if line.endswith(r" \\")]
        assert len(rows) > 1
        for row in rows:
            if not row.startswith(r"\multicolumn{2}"):
                assert len(re.findall(r"(?<!\\)&", row)) == len(columns[1])
            assert not re.search(r"(?<!\\)[_%#]", row)


def test_the_levels_by_class_are_on_the_page(written: Path, analysis: Analysis):
    text = (written / "index.html").read_text()
    assert 'id="table-levels-wd-regret"' in text
    levels = analysis.levels[analysis.levels.metric == "wd_regret"]
    assert all(f"<td>{row.iqm:.2f} [" in text for row in levels.itertuples())


def test_no_figure_cuts_off_what_it_draws(analysis: Analysis, figures: list[Any]):
    levels = analysis.levels.copy()  # the worst is in the last panel, and far above the others
    worst = (levels.class_name == "plane") & (levels.algorithm == "Alpha")
    levels.loc[worst, ["iqm", "low", "high"]] = 1.7, 1.5, 1.9
    pictures, _ = draw_figures(dataclasses.replace(analysis, levels=levels), ("svg",), {})
    assert len(figures) == len(pictures) == len(FIGURES)
    for picture, figure in zip(pictures, figures, strict=True):
        for axes in figure.axes:
            (left, right), (bottom, top) = sorted(axes.get_xlim()), sorted(axes.get_ylim())
            for line in axes.lines:
                if line.get_transform() == axes.transData:
                    for x, y in line.get_xydata():
                        assert left <= x <= right, picture.name
                        assert bottom <= y <= top, picture.name
    bottoms = {axes.get_ylim()[0] for axes in figures[2].axes}
    assert (pictures[2].name, bottoms) == ("wd-regret", {0.0})


def test_eight_algorithms_with_long_names_leave_every_figure_readable(
    analysis: Analysis, figures: list[Any]
):
    names = [f"PPO (learning_rate = 0.000{i}, n_steps = 256)" for i in range(1, 9)]
    pictures, _ = draw_figures(_with_algorithms(analysis, names), ("png",), {})
    assert len(figures) == len(pictures) == len(FIGURES)
    for figure in figures:
        assert_readable(figure)


def _with_algorithms(analysis: Analysis, names: list[str]) -> Analysis:
    """The analysis as if Alpha had been trained under each of these names."""

    def renamed(table: pd.DataFrame) -> pd.DataFrame:
        alpha = table[table.algorithm == "Alpha"]
        return pd.concat([alpha.assign(algorithm=name) for name in names], ignore_index=True)

    tables = ("results", "runs", "regions", "levels", "contrasts", "aggregates", "profiles",
              "learning_curves")  # fmt: skip
    pair = {"first": names[0], "second": names[1]}
    return dataclasses.replace(
        analysis, algorithms=tuple(names), learners=tuple(names),
        improvements=analysis.improvements[:1].assign(**pair),
        differences=analysis.differences.assign(**pair),
        **{table: renamed(getattr(analysis, table)) for table in tables},
    )  # fmt: skip


def test_within_and_out_of_distribution_are_compared_on_one_range(
    analysis: Analysis, figures: list[Any]
):
    pictures, _ = draw_figures(analysis, ("png",), {})
    drawn = dict(zip([picture.name for picture in pictures], figures, strict=True))
    for name in ("contrasts-regret", "aggregates", "differences", "improvements"):
        wd, ood = drawn[name].axes[:2]
        assert wd.get_xlim() == ood.get_xlim(), name


def test_a_heat_map_has_one_scale_that_covers_its_values_and_prints_them(
    analysis: Analysis, figures: list[Any]
):
    from sme_registry.studies.report.figures.maps import draw_regions

    regions = analysis.regions.assign(similarity=np.linspace(0.91, 0.96, len(analysis.regions)))
    draw_regions(dataclasses.replace(analysis, regions=regions), ("png",))
    panels = [axes for axes in figures[0].axes if axes.images]
    assert len(panels) == len(analysis.algorithms)
    assert {axes.images[0].get_clim() for axes in panels} == {(0.9, 1.0)}
    first = panels[0].images[0].get_array()[0, 0]
    assert panels[0].texts[0].get_text() == f"{first:.3f}".removeprefix("0")
    assert any("colours from 0.90 to 1.00" in axes.get_xlabel() for axes in figures[0].axes)


def test_maps_and_explorers_show_the_models_that_were_kept(tmp_path: Path):
    pytest.importorskip("stable_baselines3")
    from sme_registry.spec import StudyFile, StudyPlan
    from sme_registry.studies.engine.cell import run_cell

    plan = StudyPlan.from_dict(
        {
            "classes": [
                {"name": "plane", "setting": {"state_dim": 2, "action_dim": 2}, "seeds": [1]}
            ],
            "algorithms": [
                {"name": "PPO", "uses": "PPO", "hyperparameters": {"n_steps": 64, "n_epochs": 1}}
            ],
            "seeds": 1,
            "steps": 64,
            "evaluations": 1,
            "protocol": {"states_per_region": 50, "epsilons": [1.0]},
        }
    )
    ledger = Ledger(tmp_path)
    ledger.write_plan(StudyFile(name="maps", digest=plan.digest, plan=plan))
    (planned,) = plan.cells
    model = tmp_path / "model.zip"
    result = run_cell(planned.cell, model_path=model)
    ledger.write(result)
    assert "maps.png" not in {path.name for path in write_report(tmp_path, formats=["png"])}
    ledger.write(result, model.read_bytes())
    assert "maps.png" in {path.name for path in write_report(tmp_path, formats=["png"])}
    page, *_, explorer = write_report(tmp_path, formats=["html"], explorers=True)
    assert explorer.parent == page.parent / "explorers"
    assert f'<a href="explorers/{explorer.name}">PPO on plane, run 0</a>' in page.read_text()
    assert '"of":"observation"' in explorer.read_text()
    assert '"regions":{"names":["WD"' in explorer.read_text()
    words = ["explore", str(tmp_path), "--cell", result.key, "--out", str(tmp_path / "one.html")]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert (tmp_path / "one.html").read_text() == explorer.read_text()
    ledger.model_path(result.key).write_bytes(b"no model")
    text = write_report(tmp_path, formats=["html"], explorers=True)[0].read_text()
    assert "not a model that Stable-Baselines3 saved" in text
    assert "explorers/" not in text


@pytest.mark.parametrize("formats", [["gif"], []])
def test_another_format_is_refused(finished: Path, tmp_path: Path, formats: list[str]):
    with pytest.raises(OptionError, match="must be of html, png, pdf, csv, latex"):
        write_report(finished, tmp_path, formats)
    assert not list(tmp_path.iterdir())


def test_the_command_writes_into_the_study_or_another_folder(finished: Path, tmp_path: Path):
    study = tmp_path / "study"
    shutil.copytree(finished, study)
    done = CliRunner().invoke(app, ["study", "report", str(study), "--format", "csv,latex"])
    assert done.exit_code == 0, done.output
    assert (study / "report" / "tables" / "contrasts.csv").is_file()
    assert not (study / "report" / "index.html").exists()
    out = tmp_path / "elsewhere"
    CliRunner().invoke(app, ["study", "report", str(study), "-o", str(out), "--format", "csv"])
    assert (out / "tables" / "contrasts.csv").is_file()


def test_the_command_refuses_a_folder_without_a_study_or_without_results(
    finished: Path, tmp_path: Path
):
    empty = CliRunner().invoke(app, ["study", "report", str(tmp_path)])
    assert empty.exit_code == 2
    assert "holds no study" in empty.output
    shutil.copy(finished / "plan.json", tmp_path)
    planned = CliRunner().invoke(app, ["study", "report", str(tmp_path)])
    assert planned.exit_code == 2
    assert "none of its 75 runs has finished" in planned.output


def test_cells_that_no_run_asked_for_are_not_missing(finished: Path, tmp_path: Path):
    study = tmp_path / "study"
    shutil.copytree(finished, study)
    ledger = Ledger(study)
    file = ledger.plan_file()
    assert file is not None
    ledger.write_request(file, ["class=default"])
    for planned in file.plan.cells:
        if planned.class_name != "default":
            (study / "cells" / f"{planned.cell.digest[7:]}.json").unlink(missing_ok=True)
    (path,) = [p for p in write_report(study, formats=["html"]) if p.name == "index.html"]
    text = " ".join(Page(path.read_text()).text.split())
    assert "15 of 16 runs have finished. The plan has 59 more" in text  # one has failed
