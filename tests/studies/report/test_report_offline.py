"""Learning from data in a study's report, with synthetic scores."""

import pandas as pd
import pytest

from sme_registry.io.markup import fixed
from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.report.design import ALL
from sme_registry.studies.report.tables import analyse
from sme_registry.studies.report.texts import text_tables
from sme_registry.studies.result import OfflineCell
from tests.studies.finished import rows_of, study_file

pytest.importorskip("matplotlib")

from sme_registry.studies.report.findings import findings
from sme_registry.studies.report.write import write_report
from tests.studies.report.test_findings import assert_worded

CLASSES = {"shallow": {}, "deep": {"complexity": 3}}
NUS = (0.0, 0.5)
# Over the behaviour policy, by learner and class: BC imitates, IQL surpasses and then collapses.
CHANGES = {("BC", "shallow"): 0.004, ("BC", "deep"): -0.15,
           ("IQL", "shallow"): 0.05, ("IQL", "deep"): -0.4}  # fmt: skip


def planned(**fields):
    algorithms = [
        {"name": f"{name} ({nu:g})", "uses": f"offline:{name.lower()}", "action_range": "unit",
         "hyperparameters": {"nu": nu}}
        for nu in NUS
        for name in ("BC", "IQL")
    ]  # fmt: skip
    return study_file(CLASSES, **{"algorithms": algorithms, **fields})


def results(file):
    """The reports of a constant, with scores that were never reached."""
    constants = {}
    finished = {}
    for place in file.plan.cells:
        cell = place.cell
        spec = cell.spec.digest
        if spec not in constants:
            fields = {"uses": "reference:constant", "steps": 0, "hyperparameters": {}}
            constants[spec] = run_cell(cell.model_copy(update=fields))
        nu = float(str(cell.hyperparameters["nu"]))
        behaviour = 1.0 - nu / 6.0 + 0.001 * place.run
        change = CHANGES[place.algorithm.split()[0], place.class_name] + 0.0005 * (place.run - 2)
        scores = OfflineCell(
            nu=nu,
            transitions=1000,
            dataset_digest=f"sha256:{hash_of(place.class_name, nu, place.run):064x}",
            behaviour_similarity=behaviour,
            behaviour_similarity_sd=0.1,
            similarity=behaviour + change,
            similarity_sd=0.01 * (1 + place.run),
        )
        update = {"key": cell.digest, "cell": cell, "offline": scores}
        finished[cell.digest] = constants[spec].model_copy(update=update)
    return finished


def hash_of(class_name, nu, run):
    return 1000 * list(CLASSES).index(class_name) + 100 * NUS.index(nu) + run


@pytest.fixture(scope="module")
def file():
    return planned()


@pytest.fixture(scope="module")
def done(file):
    return results(file)


@pytest.fixture(scope="module")
def analysis(file, done):
    return analyse(file, done, draws=300)


def test_learners_are_named_without_their_nu_and_data_sets_count_once(analysis):
    rows = analysis.tables["offline"][["class_name", "nu", "learner", "data_sets"]]
    assert list(rows.itertuples(index=False, name=None)) == [
        (name, nu, learner, 5) for name in CLASSES for nu in NUS for learner in ("BC", "IQL")
    ]
    for row in analysis.tables["offline"].itertuples():
        assert row.runs == 5
        assert row.behaviour_similarity == pytest.approx(1.002 - row.nu / 6.0)
        assert row.similarity_sd == pytest.approx(0.03)
        assert row.improvement == pytest.approx(CHANGES[row.learner, row.class_name])
        assert row.low < row.improvement < row.high


def test_learners_of_one_kind_are_named_by_their_settings_other_than_nu():
    algorithms = [
        {"name": name, "uses": "offline:iql", "action_range": "unit", "hyperparameters": settings}
        for name, settings in (("IQL b", {"nu": 0.5, "expectile": 0.9}), ("IQL a", {"nu": 0.5}))
    ]
    file = planned(algorithms=algorithms, seeds=1)
    analysis = analyse(file, results(file), draws=300)
    assert list(analysis.tables["offline"].learner) == [
        "IQL (expectile = 0.9)", "IQL (default expectile)",
    ] * 2  # fmt: skip


def of_learner(analysis, name):
    """The sentences on a learner, by verdict."""
    rows = rows_of(findings(analysis), section="offline", algorithm=name)
    return dict(zip(rows.verdict, rows.sentence, strict=True))


def test_findings_name_who_imitates_who_surpasses_and_who_collapses(analysis):
    assert_worded(analysis)
    bc, iql = (of_learner(analysis, name) for name in ("BC", "IQL"))
    assert set(bc) == {"near", "above", "below", "like_constant"}
    assert set(iql) == {"above", "below", "like_constant"}
    assert "made its data at shallow (ν = 0, 0.5): " in bc["near"]
    places = "at shallow (ν = 0, 0.5): r̃ − r̃ of the data is +0.050."
    assert iql["above"] == f"IQL surpasses its data {places}"
    assert iql["below"].startswith("IQL falls behind its data at deep (ν = 0, 0.5)")
    assert iql["like_constant"].startswith("IQL is no better than the constant ½ at deep (ν = 0, 0")
    assert "few runs" not in questions(analysis)


def questions(analysis):
    return set(findings(analysis).question)


@pytest.mark.parametrize("runs", [1, 4])
def test_few_runs_give_indications_at_most(file, done, runs):
    keys = {place.cell.digest for place in file.plan.cells if place.run < runs}
    few = analyse(file, {key: done[key] for key in keys}, draws=300)
    assert set(few.tables["offline"].low.isna()) == {runs < 4}
    iql = of_learner(few, "IQL")
    assert not {"above", "below"} & set(iql)
    assert ("above_few" in iql) == (runs > 1)
    assert ("open" in iql) == (runs == 1)
    assert "few runs" in questions(few)
    assert_worded(few)


def test_only_learners_with_equal_data_are_compared(analysis):
    rows = rows_of(analysis.tables["improvements"], group=ALL)
    pairs = set(zip(rows["first"], rows["second"], strict=True))
    learners = {("BC (0)", "IQL (0)"), ("BC (0.5)", "IQL (0.5)")}
    assert pairs == learners
    found = findings(analysis)
    best, pairs = (found[found.question == each] for each in ("best", "improvement"))
    assert list(best.algorithm) == list(pairs.algorithm) == ["BC (0)", "BC (0.5)"]
    assert "of those with data of ν = 0.5: " in best.sentence.iloc[1]
    beaten = ["beats one of IQL (0) ", "beats one of IQL (0.5) "]
    assert all(name in text for name, text in zip(beaten, pairs.sentence, strict=True))


def test_learning_from_data_comes_first_in_the_report_and_has_every_format(
    file, done, tmp_path, drawn
):
    ledger = Ledger(tmp_path / "study")
    ledger.write_plan(file)
    for result in done.values():
        ledger.write(result)
    out = tmp_path / "out"
    write_report(tmp_path / "study", out, full=True)
    labels = {axes.get_xlabel() for figure in drawn for axes in figure.axes}
    assert "gradient steps" in labels
    for ending in ("png", "pdf"):
        assert (out / "figures" / f"offline-improvement.{ending}").exists()
    page = (out / "index.html").read_text()
    assert page.index('<section id="offline"') < page.index('<section id="findings"')
    assert page.count('id="table-offline"') == page.count('id="figure-offline-improvement"') == 1
    for name in ("offline", "offline-improvement"):
        text = (out / "tables" / f"{name}.tex").read_text()
        assert text.isascii()
        assert "$\\nu$" in text
    rows = pd.read_csv(out / "tables/results.csv").drop_duplicates(
        ["class_name", "algorithm", "run"]
    )
    assert len(rows) == len(done)
    difference = rows.offline_similarity - rows.behaviour_similarity
    assert list(rows.improvement) == pytest.approx(list(difference), abs=1e-12)


def test_the_table_has_the_behaviour_policy_next_to_the_learners(analysis):
    tables = {table.name: table.frame for table in text_tables(analysis)}
    similarities, improvements = tables["offline"], tables["offline-improvement"]
    constant = fixed(analysis.tables["offline"].constant_similarity[0], 3)
    assert similarities.iloc[0].to_dict() == {
        "class": "shallow",
        "ν": "0",
        "constant ½": constant,
        "behaviour policy": "1.002 ± 0.100 (5)",
        "BC": "1.006 ± 0.030 (5)",
        "IQL": "1.052 ± 0.030 (5)",
    }
    assert improvements.BC[0].startswith("+0.004 [")
    assert improvements.IQL.iloc[-1].endswith(" †")
