"""Bundles: reading untrusted folders, and building completely or not at all."""

import hashlib
import json
import os
import shutil

import pytest

from leaderboard.bundle import Bundle, make_bundle
from leaderboard.documents.board import hex_of
from leaderboard.documents.signed import MAX_BYTES, SigningKey
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES, Description, Training
from leaderboard.errors import Rejection
from leaderboard.gate.networks import constant_onnx, optimal_onnx
from sme_registry import SMESpec, save
from sme_registry.errors import OptionError, SMEError, SpecError
from sme_registry.spec import StudyFile, StudyPlan, Suite, SuiteFile
from sme_registry.studies import run_study
from sme_registry.studies.result import CellFailure, CellResult
from sme_registry.training import train
from sme_registry.training.record import RunRecord
from tests.leaderboard.conftest import suite_of

SUITE = suite_of(A=(2, {}), B=(1, {"state_dim": 3, "action_dim": 2}))
FILE = SuiteFile(name="two", version=1, digest=SUITE.digest, suite=SUITE)
A0, A1, B0 = SUITE.instances
KEY = SigningKey.generate()


def row(spec, policy, seed=0, steps=10):
    return {"spec": spec.digest, "policy": policy, "steps": steps, "seed": seed}


def write_table(folder):
    """A table of one run on each instance, the last of which failed, and its two policies."""
    (folder / "a0.onnx").write_bytes(optimal_onnx(A0))
    (folder / "a1.onnx").write_bytes(optimal_onnx(A1))
    return rewritten(folder / "runs.json", [row(A0, "a0.onnx"), row(A1, "a1.onnx"), row(B0, None)])


@pytest.fixture
def table(tmp_path):
    folder = tmp_path / "runs"
    folder.mkdir()
    return write_table(folder)


def rewritten(table, rows):
    table.write_text(json.dumps(rows))
    return table


def made(folder, *runs, **kwargs):
    own = {name: kwargs.pop(name) for name in Description._fields if name in kwargs}
    description = Description(**{"method": "Mine", "submitter": "A Lab", **own})
    return make_bundle(folder, description, runs=runs, **{"suite": FILE, "key": KEY, **kwargs})


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A bundle; nobody changes it."""
    return made(
        tmp_path_factory.mktemp("whole") / "bundle", write_table(tmp_path_factory.mktemp("runs"))
    )


@pytest.fixture
def bundle(tmp_path, whole):
    return Bundle.read(shutil.copytree(whole.folder, tmp_path / "bundle"))


def digest_of(bundle, index=0):
    return bundle.signed.content.runs[index].artefact.sha256


def artefact_path(bundle):
    return bundle.folder / "artefacts" / f"{hex_of(digest_of(bundle))}.onnx"


def refused(code, match, act, *arguments, **kwargs):
    with pytest.raises(Rejection, match=match) as caught:
        act(*arguments, **kwargs)
    assert caught.value.code == code


# --- reading -----------------------------------------------------------------------------------


def test_a_table_becomes_a_signed_submission_that_reads_as_it_was_made(whole):
    read = Bundle.read(str(whole.folder))
    assert read == whole
    submission = read.signed.content
    assert read.signed.id == submission.digest
    for run, spec in zip(submission.runs[:2], (A0, A1), strict=True):
        assert read.artefact(run.artefact.sha256) == optimal_onnx(spec)
    assert (submission.suite.name, submission.suite.digest) == ("two-v1", SUITE.digest)
    assert submission.submitter.key == KEY.public
    assert (submission.method.name, submission.method.family) == ("Mine", "Mine")
    assert [run.spec for run in submission.runs] == [A0.digest, A1.digest, B0.digest]
    assert submission.runs[2].artefact is None
    assert submission.runs_started == {"A": 2, "B": 1}
    assert submission.training == Training()
    names = {path.stem for path in (whole.folder / "artefacts").iterdir()}
    assert names == {hashlib.sha256(optimal_onnx(spec)).hexdigest() for spec in (A0, A1)}


def test_a_missing_or_changed_submission_is_refused(tmp_path, bundle):
    for folder in (tmp_path, tmp_path / "absent"):
        with pytest.raises(OptionError, match="contains no submission"):
            Bundle.read(folder)
    path = bundle.folder / "submission.json"
    path.write_text(path.read_text().replace('"Mine"', '"Yours"'))
    refused("bad_signature", "invalid for this submission", Bundle.read, bundle.folder)


def test_a_file_above_its_limit_is_not_read_to_its_end(bundle):
    path = bundle.folder / "submission.json"
    for large in (path, artefact_path(bundle)):
        with large.open("r+b") as stream:
            stream.truncate(2**40)  # a hole: reading it whole would never end
    match = f"^too_large: submission.json: must be at most {MAX_BYTES:,} bytes. List"
    refused("too_large", match, Bundle.read, bundle.folder)
    match = f"at most {MAX_ARTEFACT_BYTES:,} bytes. List fewer runs, or submit smaller networks."
    refused("too_large", match, bundle.artefact, digest_of(bundle))


def test_an_artefact_that_is_missing_is_refused(bundle):
    artefact_path(bundle).unlink()
    missing = ("artefact_missing", "is missing from the bundle")
    refused(*missing, bundle.artefact, digest_of(bundle))
    shutil.rmtree(bundle.folder / "artefacts")
    refused(*missing, bundle.artefact, digest_of(bundle))


def test_bytes_that_are_not_the_signed_ones_are_refused(bundle):
    path = artefact_path(bundle)
    data = path.read_bytes()
    for changed in (data[:-1], data[:-1] + b"\xff"):
        path.write_bytes(changed)
        refused("artefact_digest", "must be sha256:", bundle.artefact, digest_of(bundle))


def replaced_by_link(path, target):
    target.parent.mkdir(exist_ok=True)
    os.rename(path, target)
    path.symlink_to(target)


def replaced_by_pipe(path, target):
    path.unlink()
    os.mkfifo(path)


def test_only_regular_files_are_read(tmp_path, whole):
    match = "must be a regular file inside the bundle"
    for replace in (replaced_by_link, replaced_by_pipe):
        home = tmp_path / replace.__name__
        bundle = Bundle.read(shutil.copytree(whole.folder, home / "bundle"))
        assert bundle.signed == whole.signed
        replace(artefact_path(bundle), home / "elsewhere" / "policy.onnx")
        refused("artefact_path", match, bundle.artefact, digest_of(bundle))
        replace(bundle.folder / "submission.json", home / "elsewhere" / "submission.json")
        refused("artefact_path", match, Bundle.read, bundle.folder)
    bundle = Bundle.read(shutil.copytree(whole.folder, tmp_path / "bundle"))
    replaced_by_link(bundle.folder / "artefacts", tmp_path / "elsewhere" / "artefacts")
    refused("artefact_path", match, bundle.artefact, digest_of(bundle))


# --- making ------------------------------------------------------------------------------------


def test_specs_of_a_table_may_be_ids_digests_or_paths(tmp_path, table):
    suite = Suite.from_dict({"classes": [{"name": "D", "setting": {}, "seeds": [0, 1]}]})
    file = SuiteFile(name="default", digest=suite.digest, suite=suite)
    save(suite.instances[1], table.parent / "one.json")
    (table.parent / "default.onnx").write_bytes(optimal_onnx(suite.instances[0]))
    rows = [
        {**row(A0, None if seed else "default.onnx", seed), "spec": spec}
        for seed, spec in enumerate(["SME/Default-v1", SMESpec().digest, "one.json"])
    ]
    submission = made(tmp_path / "bundle", rewritten(table, rows), suite=file).signed.content
    default, other = suite.instances
    assert [run.spec for run in submission.runs] == [default.digest, default.digest, other.digest]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with the folder of one short run, on the first instance."""
    folder = tmp_path_factory.mktemp("trained")
    train(
        A0,
        algorithm="A2C",
        steps=10,
        seed=3,
        folder=folder / "A2C" / "0",
        protocol={"states_per_region": 2},
        progress=False,
    )
    return folder


@pytest.fixture
def failed(table):
    """A table of a failed run on each of the other instances."""
    return rewritten(table, [row(A1, None), row(B0, None)])


def test_trained_runs_are_exported_with_their_records(tmp_path, trained, failed):
    bundle = made(tmp_path / "bundle", trained, failed)
    submission = Bundle.read(bundle.folder).signed.content
    run = submission.runs[0]
    assert (run.spec, run.seed, run.steps) == (A0.digest, 3, 10)
    assert bundle.artefact(run.artefact.sha256)
    assert [run.artefact for run in submission.runs[1:]] == [None, None]
    assert "stable_baselines3 2." in submission.training.library
    assert submission.training.hyperparameters == "A2C, defaults; actions in [-1, 1]; num_envs=1"
    assert submission.training.hardware.startswith("CPU; ")
    assert sorted(path.name for path in bundle.folder.iterdir()) == ["artefacts", "submission.json"]


def test_a_saved_model_may_stand_in_a_table_and_facts_that_are_given_are_taken(
    tmp_path, trained, table
):
    shutil.copy(trained / "A2C" / "0" / "model.zip", table.parent)
    rows = [row(A0, "model.zip", 7), row(A1, None), row(B0, None)]
    facts = Training(library="own", hyperparameters="own", hardware="a laptop")
    bundle = made(tmp_path / "bundle", rewritten(table, rows), training=facts)
    assert bundle.artefact(digest_of(bundle))
    assert bundle.signed.content.training == facts


def test_records_of_runs_are_cut_and_unfinished_repeated_or_missing_runs_refused(
    tmp_path, trained, failed
):
    copied = shutil.copytree(trained, tmp_path / "copied")
    folder = copied / "A2C" / "0"
    long = {"hyperparameters": {"x": "x" * 3000}, "versions": {"torch": "y" * 300}}
    RunRecord.read(folder).updated(**long).write(folder)
    facts = made(tmp_path / "long", copied, failed).signed.content.training
    assert len(facts.hyperparameters) == 2000  # what a submission holds
    assert len(facts.library) == 200

    RunRecord.read(folder).updated(independent=True).write(folder)
    nothing_is_left(tmp_path, OptionError, "0: has a model for each agent", copied)
    RunRecord.read(folder).updated(independent=False, status="running").write(folder)
    nothing_is_left(tmp_path, OptionError, "0: contains an unfinished run", copied)
    RunRecord.read(folder).updated(status="finished").write(folder)
    (folder / "model.zip").unlink()
    nothing_is_left(tmp_path, OptionError, "0: contains an unfinished run", copied)

    match = r"A2C/0: seed=3: .*A2C/0 has the same"
    nothing_is_left(tmp_path, Rejection, match, trained, trained, failed)
    match = f"missing_run: runs: none on {A0.digest}.*policy null"
    nothing_is_left(tmp_path, Rejection, match, trained, failed, algorithm="TD3")
    assert made(tmp_path / "bundle", trained, failed, algorithm="a2c")


# --- what cannot be made leaves nothing --------------------------------------------------------


def nothing_is_left(tmp_path, error, match, *runs, **kwargs):
    home = tmp_path / "home"
    with pytest.raises(error, match=match):
        made(home / "bundle", *runs, **kwargs)
    assert not home.exists() or list(home.iterdir()) == []


@pytest.mark.parametrize(
    ("rows", "error", "match"),
    [
        ([row(A0, "a0.onnx"), row(A0, None)], Rejection, "duplicate_run: .*same spec and seed"),
        ([row(A0, "a0.onnx")], Rejection, "missing_run: runs: none on"),
        (
            [row(SMESpec(), None)],
            Rejection,
            r"unknown_spec: .*run 0: .*instances \(`sme show two-v1`\)",
        ),
        ({"spec": 1}, SpecError, "must be a list of runs"),
        ([{"spec": A0.digest, "policy": None, "steps": 1}], SpecError, "run 0: seed: missing"),
        ([{**row(A0, None), "step": 1}], SpecError, "step=1: unknown field. Did you mean 'steps'"),
        ([row(A0, None, seed=-1)], SpecError, "seed=-1"),
        ([{**row(A0, None), "spec": "SME/Defalt-v1"}], SpecError, "run 0: .*Did you mean"),
        ([row(A0, "a0.pt")], SpecError, "policy='a0.pt': must be the path of an .onnx"),
        ([row(A0, "absent.onnx"), row(A1, None), row(B0, None)], OptionError, "cannot be read"),
        (
            [row(A0, None), row(A1, None), row(B0, "a0.onnx")],
            Rejection,
            r"onnx_interface: .*runs.json, run 2: ",
        ),
    ],
)
def test_a_table_that_is_wrong_is_refused(tmp_path, table, rows, error, match):
    nothing_is_left(tmp_path, error, match, rewritten(table, rows))


def test_a_policy_above_the_limit_and_a_path_that_is_no_run_are_refused(tmp_path, table):
    with (table.parent / "a1.onnx").open("r+b") as stream:
        stream.truncate(2**40)
    nothing_is_left(tmp_path, Rejection, "too_large: .*runs.json, run 1", table)
    (tmp_path / "empty").mkdir()
    for path in ("absent.json", "empty"):
        nothing_is_left(tmp_path, OptionError, f"runs='.*{path}': must be", tmp_path / path)


@pytest.mark.parametrize(
    ("fields", "error", "match"),
    [
        ({"method": "<b>"}, Rejection, "unsafe_name: method.name"),
        ({"code": "http://plain.org"}, SpecError, "code='http://plain.org': must be an https:"),
        ({"code": "https://" + "a" * 293}, SpecError, "code='https://a+…: .*at most 300"),
        ({"runs_started": {"A": 1}}, Rejection, "missing_run: runs_started.A=1"),
        ({"knowledge": "all"}, SpecError, "knowledge='all'"),
        ({"runs": 600}, Rejection, "too_large: submission.json: .* List fewer runs"),
    ],
)
def test_what_the_board_would_refuse_is_refused_before_exporting(
    tmp_path, table, fields, error, match
):
    seen, fields = [], dict(fields)
    count = fields.pop("runs", 0) // 3
    if count:
        rows = [row(spec, "a0.onnx", seed) for spec in SUITE.instances for seed in range(count)]
        rewritten(table, rows)
    nothing_is_left(
        tmp_path, error, match, table, progress=lambda *counts: seen.append(counts), **fields
    )
    assert seen == []


def test_an_existing_bundle_is_replaced_only_with_force_and_as_a_whole(tmp_path, table, bundle):
    with pytest.raises(OptionError, match="bundle already exists"):
        made(bundle.folder, table, method="Other")
    (table.parent / "a1.onnx").write_bytes(b"no model")
    with pytest.raises(Rejection):
        made(bundle.folder, table, force=True)
    assert Bundle.read(bundle.folder) == bundle
    write_table(table.parent)
    again = made(bundle.folder, table, method="Other", force=True)
    assert Bundle.read(bundle.folder).signed == again.signed != bundle.signed
    assert {path.name for path in tmp_path.iterdir()} == {"runs", "bundle"}


def test_what_is_no_bundle_is_never_replaced(tmp_path, table, bundle):
    file, folder, link = (tmp_path / name for name in ("file", "folder", "link"))
    file.write_text("all of it")
    folder.mkdir()
    (folder / "thesis.tex").write_text("all of it")
    link.symlink_to(bundle.folder)
    for target in (file, folder, link):
        match = f"{target.name}: is not a bundle, or contains other files"
        with pytest.raises(OptionError, match=match):
            made(target, table, force=True)
    assert link.is_symlink()
    assert Bundle.read(bundle.folder) == bundle
    assert file.read_text() == (folder / "thesis.tex").read_text() == "all of it"
    with pytest.raises(SMEError, match="cannot be written"):
        made(file / "bundle", table)


def test_one_policy_may_stand_for_two_instances_and_more_runs_may_have_started(tmp_path, table):
    (table.parent / "half.onnx").write_bytes(constant_onnx(A0))
    rows = [row(A0, "half.onnx"), row(A1, "half.onnx"), row(B0, None)]
    seen = []
    bundle = made(
        *(tmp_path / "bundle", rewritten(table, rows)),
        method="Weighted BC",
        runs_started={"B": 7},
        progress=lambda *counts: seen.append(counts),
    )
    assert len(list((bundle.folder / "artefacts").iterdir())) == 1
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert bundle.signed.content.runs_started == {"A": 2, "B": 7}
    method = bundle.signed.content.method
    assert (method.name, method.family) == ("Weighted BC", "Weighted BC")  # as they were given


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A study of the suite: one algorithm ran, with its models kept, and one did not."""
    folder = tmp_path_factory.mktemp("study") / "runs"
    names = {"A2C": "A2C", "Other": "TD3"}
    fields = {
        "classes": [one.to_dict() for one in SUITE.classes],
        "algorithms": [{"name": name, "uses": uses} for name, uses in names.items()],
        "seeds": 2,
        "steps": 10,
        "evaluations": 1,
        "evaluation_episodes": 1,
        "protocol": {"states_per_region": 2},
    }
    plan = StudyPlan.from_dict(fields)
    file = StudyFile(name="two", digest=plan.digest, plan=plan)
    only = ["algorithm=A2C"]
    run_study(file, folder, executor="in-process", keep_models=True, only=only)
    return folder


def test_the_runs_of_a_study_are_submitted_with_their_records(tmp_path, study):
    bundle = made(tmp_path / "bundle", study)  # the only algorithm that ran
    submission = Bundle.read(bundle.folder).signed.content
    assert {run.spec for run in submission.runs} == {spec.digest for spec in SUITE.instances}
    assert all(run.steps >= 10 and run.artefact is not None for run in submission.runs)
    assert "stable_baselines3" in submission.training.library
    assert submission.training.hyperparameters.startswith("A2C, default hyperparameters")
    assert made(tmp_path / "same", study, algorithm="a2c").signed.content.runs
    with pytest.raises(OptionError, match=r"4 of 4 runs are not finished"):
        made(tmp_path / "other", study, algorithm="Other")
    with pytest.raises(OptionError, match=r"algorithm='TD3': .* has runs of A2C"):
        made(tmp_path / "other", study, algorithm="TD3")
    assert not (tmp_path / "other").exists()


def test_a_failed_run_of_a_study_is_submitted_without_a_policy(tmp_path, study):
    copy = shutil.copytree(study, tmp_path / "copy")
    result = next((copy / "cells").iterdir())
    cell = CellResult.from_dict(json.loads(result.read_text()))
    failure = CellFailure(key=cell.key, cell=cell.cell, error="diverged", traceback="", versions={})
    (copy / "failed").mkdir(exist_ok=True)
    (copy / "failed" / result.name).write_text(json.dumps(failure.to_dict()))
    result.unlink()
    runs = made(tmp_path / "bundle", copy).signed.content.runs
    failed = [run for run in runs if run.artefact is None]
    assert [(run.spec, run.seed) for run in failed] == [(cell.cell.spec.digest, cell.cell.seed)]
    shutil.rmtree(copy / "models")
    with pytest.raises(OptionError, match="--keep-models"):
        made(tmp_path / "without", copy)
