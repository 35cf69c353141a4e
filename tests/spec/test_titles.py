"""What tables and figures call a task, and what consoles and notebooks show of documents."""

import pickle

import pytest

import sme_registry
from sme_registry import EvaluationReport, SMESpec, evaluate, load, register, save
from sme_registry.spec import ProtocolFile, StudyFile, SuiteFile, catalogue

OTHER = SMESpec(state_dim=2, action_dim=2, k=2, seed=5)
QUICK = {"states_per_region": 20, "epsilons": [0.5]}


@pytest.fixture
def named(tmp_path):
    return load(save(OTHER, tmp_path / "k2.json"))


def test_a_task_of_a_file_has_the_name_of_its_file(named):
    assert named.name == catalogue.title(named) == "k2"
    assert catalogue.title(pickle.loads(pickle.dumps(named))) == "k2"
    assert catalogue.title(OTHER) == f"SME/{OTHER.content_name}"
    assert catalogue.title(load("Default")) == "SME/Default-v1"


def test_a_name_is_no_part_of_a_spec(named):
    assert (named, hash(named), named.digest) == (OTHER, hash(OTHER), OTHER.digest)
    assert OTHER.name == ""
    assert named.to_dict() == OTHER.to_dict()
    assert named != OTHER.derive(k=3)
    assert named.derive(k=3).name == ""  # another task


def test_a_file_cannot_pose_as_a_task_of_the_catalogue(tmp_path):
    for name in ("Default", "Default-v1"):
        spec = load(save(OTHER, tmp_path / "mine.json", name=name, force=True))
        assert catalogue.title(spec) == f"{name} ({OTHER.content_name})"
    assert catalogue.title(load(save(SMESpec(), tmp_path / "ours.json"))) == "SME/Default-v1"
    assert catalogue.title(load(register(OTHER.derive(seed=6), "Mine"))) == "SME/Mine-v1"


def test_tasks_of_one_name_are_told_apart(named):
    twin = OTHER.derive(seed=7).named("k2")
    titles = catalogue.titles([named, SMESpec(), twin, named])
    assert titles == {
        OTHER.digest: f"k2 ({OTHER.content_name})",
        SMESpec().digest: "SME/Default-v1",
        twin.digest: f"k2 ({twin.content_name})",
    }


def test_a_report_keeps_the_name_in_its_file(tmp_path, named):
    report = evaluate("constant", named, QUICK)
    again = EvaluationReport.read(report.write(tmp_path / "evaluation.json"))
    assert report.title == again.title == "k2"
    assert str(again).startswith("constant on k2\n")
    assert "task" not in evaluate("constant", OTHER, QUICK).to_dict()


def test_no_document_fills_a_screen():
    for kind, name in ((SuiteFile, "core"), (StudyFile, "smoke"), (ProtocolFile, "paper")):
        assert len(repr(catalogue.find(kind, name))) < 400
    assert "agents=<tuple of 4>" in repr(sme_registry.load("Team4"))
    spec = SMESpec(complexity=5)
    assert eval(repr(spec)) == spec
    assert "k=5, r_min=0.123456789" in SMESpec(r_min=0.123456789, k=5)._repr_html_()


def test_a_notebook_shows_a_tasks_fields_name_and_digest():
    spec = SMESpec(complexity=5, k=3).named("<Mine>")
    html = spec._repr_html_()
    for text in ("complexity", "<b>5</b>\ndefault 1", spec.digest, "&lt;Mine&gt;"):
        assert text in html
    assert "<Mine>" not in html
    assert "Not the default: k=3, complexity=5" in html
    assert ">L</b>" in html  # its symbol
    assert "layers of the optimal policy" in html  # its meaning
    assert html.count("\ndefault ") == 2
    assert "safety" not in html  # not set
    stream = sme_registry.load("Switch5")._repr_html_()
    assert stream.count(">seed=") == 4
