"""Bundles: reading untrusted folders, and building completely or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import shutil

import pytest

from leaderboard.artefact.reference import constant_onnx, optimal_onnx
from leaderboard.bundle import Bundle, make_bundle
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES, MAX_BYTES, Training
from leaderboard.errors import Rejection
from sme_registry import SMESpec, save
from sme_registry.errors import OptionError, PolicyError, SMEError, SpecError
from sme_registry.spec import StudyFile, StudyPlan, Suite, SuiteFile
from sme_registry.studies import CellResult, run_study
from sme_registry.studies.engine.result import CellFailure
from sme_registry.training import RunRecord, train

SUITE = Suite.from_dict(
    {
        "classes": [
            {"name": "A", "setting": {"state_dim": 2, "action_dim": 1}, "seeds": [0, 1]},
            {"name": "B", "setting": {"state_dim": 3, "action_dim": 2}, "seeds": [0]},
        ]
    }
)
FILE = SuiteFile(name="two", version=1, digest=SUITE.digest, suite=SUITE)
A0, A1, B0 = SUITE.instances
KEY = SigningKey.generate()


def row(spec, policy, seed=0, steps=10):
    return {"spec": spec.digest, "policy": policy, "steps": steps, "seed": seed}


@pytest.fixture
def table(tmp_path):
    """A table of one run on each instance, the last of which failed, and its two policies."""
    folder = tmp_path / "runs"
    folder.mkdir()
    (folder / "a0.onnx").write_bytes(optimal_onnx(A0))
    (folder / "a1.onnx").write_bytes(optimal_onnx(A1))
    return rewritten(folder / "runs.json", [row(A0, "a0.onnx"), row(A1, "a1.onnx"), row(B0, None)])


def rewritten(table, rows):
    table.write_text(json.dumps(rows))
    return table


def made(folder, *runs, **kwargs):
    kwargs = {"suite": FILE, "key": KEY, "method": "Mine", "submitter": "A Lab", **kwargs}
    return make_bundle(folder, runs=runs, **kwargs)


@pytest.fixture
def bundle(tmp_path, table):
    return made(tmp_path / "bundle", table)


def artefact_path(bundle, index=0):
    digest = bundle.signed.submission.runs[index].artefact.sha256
    return bundle.folder / "artefacts" / f"{digest.removeprefix('sha256:')}.onnx"


def refused(code, match, act, *arguments, **kwargs):
    with pytest.raises(Rejection, match=match) as caught:
        act(*arguments, **kwargs)
    assert caught.value.code == code


# --- reading -----------------------------------------------------------------------------------


def test_a_bundle_reads_as_it_was_made(bundle):
    read = Bundle.read(str(bundle.folder))
    assert read == bundle
    assert read.signed.id == bundle.signed.submission.digest
    for run, spec in zip(read.signed.submission.runs[:2], (A0, A1), strict=True):
        assert read.artefact(run.artefact.sha256) == optimal_onnx(spec)


def test_a_folder_without_a_submission_is_refused(tmp_path):
    with pytest.raises(OptionError, match="contains no submission"):
        Bundle.read(tmp_path)
    with pytest.raises(OptionError, match="contains no submission"):
        Bundle.read(tmp_path / "absent")


def test_a_changed_submission_is_refused(bundle):
    path = bundle.folder / "submission.json"
    path.write_text(path.read_text().replace('"Mine"', '"Yours"'))
    refused("bad_signature", "invalid for this submission", Bundle.read, bundle.folder)


def test_a_submission_above_the_limit_is_not_read_to_its_end(bundle):
    with (bundle.folder / "submission.json").open("r+b") as stream:
        stream.truncate(2**40)  # a hole: reading it whole would never end
    refused(
        "too_large",
        f"^too_large: submission.json: must be at most {MAX_BYTES:,} bytes. List",
        Bundle.read,
        bundle.folder,
    )


def test_an_artefact_that_no_run_names_is_refused(bundle):
    for digest in ("sha256:" + "0" * 64, "../../etc/passwd", "sha256:../../../etc/passwd"):
        refused("artefact_missing", "no run of the submission names it", bundle.artefact, digest)


def test_a_missing_artefact_is_refused(bundle):
    digest = bundle.signed.submission.runs[0].artefact.sha256
    artefact_path(bundle).unlink()
    refused("artefact_missing", "is missing from the bundle", bundle.artefact, digest)
    shutil.rmtree(bundle.folder / "artefacts")
    refused("artefact_missing", "is missing from the bundle", bundle.artefact, digest)


@pytest.mark.parametrize("change", [lambda data: data[:-1], lambda data: data[:-1] + b"\xff"])
def test_changed_bytes_are_refused(bundle, change):
    path = artefact_path(bundle)
    path.write_bytes(change(path.read_bytes()))
    digest = bundle.signed.submission.runs[0].artefact.sha256
    refused("artefact_digest", "must be .* bytes of sha256:", bundle.artefact, digest)


def test_a_size_that_is_not_the_artefacts_is_refused(bundle):
    run = bundle.signed.submission.runs[0]
    lying = run.model_copy(update={"artefact": run.artefact.model_copy(update={"size": 5})})
    submission = bundle.signed.submission.model_copy(
        update={"runs": (lying, *bundle.signed.submission.runs[1:])}
    )
    changed = Bundle(bundle.folder, submission.signed(KEY))
    refused("artefact_digest", "must be 5 bytes", changed.artefact, run.artefact.sha256)


def test_an_artefact_above_the_limit_is_not_read_to_its_end(bundle):
    with artefact_path(bundle).open("r+b") as stream:
        stream.truncate(2**40)
    digest = bundle.signed.submission.runs[0].artefact.sha256
    refused(
        "too_large",
        f"at most {MAX_ARTEFACT_BYTES:,} bytes. Submit a smaller network.",
        bundle.artefact,
        digest,
    )


@pytest.fixture(params=["relative to folders", "by path"])
def reading(request, monkeypatch):
    """Each test that takes it runs with and without the calls that Windows lacks."""
    if request.param == "by path":
        monkeypatch.setattr(os, "supports_dir_fd", set())


def replaced_by_link(path, target):
    target.parent.mkdir(exist_ok=True)
    os.rename(path, target)
    path.symlink_to(target)


def replaced_by_folder(path, target):
    path.unlink()
    path.mkdir()


def replaced_by_pipe(path, target):
    path.unlink()
    os.mkfifo(path)


def replaced_by_nowhere(path, target):
    path.unlink()
    path.symlink_to(target / "absent")


@pytest.mark.parametrize(
    "replace", [replaced_by_link, replaced_by_folder, replaced_by_pipe, replaced_by_nowhere]
)
def test_only_regular_files_are_read(bundle, tmp_path, reading, replace):
    assert Bundle.read(bundle.folder) == bundle
    digest = bundle.signed.submission.runs[0].artefact.sha256
    replace(artefact_path(bundle), tmp_path / "elsewhere" / "policy.onnx")
    refused("artefact_path", "must be a regular file inside the bundle", bundle.artefact, digest)
    replace(bundle.folder / "submission.json", tmp_path / "elsewhere" / "submission.json")
    refused("artefact_path", "must be a regular file", Bundle.read, bundle.folder)


def test_a_folder_of_artefacts_that_is_a_link_is_refused(bundle, tmp_path, reading):
    replaced_by_link(bundle.folder / "artefacts", tmp_path / "elsewhere" / "artefacts")
    digest = bundle.signed.submission.runs[0].artefact.sha256
    refused("artefact_path", "must be a regular file inside the bundle", bundle.artefact, digest)


# --- making ------------------------------------------------------------------------------------


def test_a_table_becomes_a_signed_submission(bundle):
    submission = bundle.signed.submission
    assert submission.suite.name == "two-v1"
    assert submission.suite.digest == SUITE.digest
    assert submission.submitter.key == KEY.public
    assert (submission.method.name, submission.method.family) == ("Mine", "Mine")
    assert [run.spec for run in submission.runs] == [A0.digest, A1.digest, B0.digest]
    assert submission.runs[2].artefact is None
    assert submission.runs_started == {"A": 2, "B": 1}
    assert submission.training == Training()
    names = {path.stem for path in (bundle.folder / "artefacts").iterdir()}
    assert names == {hashlib.sha256(optimal_onnx(spec)).hexdigest() for spec in (A0, A1)}


def test_more_runs_may_have_been_started(tmp_path, table):
    assert made(tmp_path / "b", table, runs_started={"B": 7}).signed.submission.runs_started == {
        "A": 2,
        "B": 7,
    }


def test_progress_counts_the_runs(tmp_path, table):
    seen = []
    made(tmp_path / "bundle", table, progress=lambda *counts: seen.append(counts))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_specs_of_a_table_may_be_ids_digests_or_paths(tmp_path, table):
    suite = Suite.from_dict({"classes": [{"name": "D", "setting": {}, "seeds": [0, 1]}]})
    file = SuiteFile(name="default", digest=suite.digest, suite=suite)
    save(suite.instances[1], table.parent / "one.json")
    (table.parent / "default.onnx").write_bytes(optimal_onnx(suite.instances[0]))
    rows = [
        {**row(A0, None if seed else "default.onnx", seed), "spec": spec}
        for seed, spec in enumerate(["SME/Default-v1", SMESpec().digest, "one.json"])
    ]
    submission = made(tmp_path / "bundle", rewritten(table, rows), suite=file).signed.submission
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
    submission = Bundle.read(bundle.folder).signed.submission
    run = submission.runs[0]
    assert (run.spec, run.seed, run.steps) == (A0.digest, 3, 10)
    assert bundle.artefact(run.artefact.sha256)
    assert [run.artefact for run in submission.runs[1:]] == [None, None]
    assert "stable_baselines3 2." in submission.training.library
    assert submission.training.hyperparameters == "A2C, defaults; actions in [-1, 1]; num_envs=1"
    assert submission.training.hardware.startswith("CPU; ")
    assert sorted(path.name for path in bundle.folder.iterdir()) == ["artefacts", "submission.json"]


def test_a_saved_model_may_stand_in_a_table(tmp_path, trained, table):
    shutil.copy(trained / "A2C" / "0" / "model.zip", table.parent)
    rows = [row(A0, "model.zip", 7), row(A1, None), row(B0, None)]
    bundle = made(tmp_path / "bundle", rewritten(table, rows))
    assert bundle.artefact(bundle.signed.submission.runs[0].artefact.sha256)


def test_facts_that_are_given_are_taken(tmp_path, trained, failed):
    facts = Training(library="own", hyperparameters="own", hardware="a laptop")
    bundle = made(tmp_path / "bundle", trained, failed, training=facts)
    assert bundle.signed.submission.training == facts


def test_facts_are_cut_to_what_a_submission_holds(tmp_path, trained, failed):
    copied = shutil.copytree(trained, tmp_path / "copied")
    folder = copied / "A2C" / "0"
    record = RunRecord.read(folder)
    record.updated(hyperparameters={"x": "x" * 3000}, versions={"torch": "y" * 300}).write(folder)
    facts = made(tmp_path / "bundle", copied, failed).signed.submission.training
    assert len(facts.hyperparameters) == 2000
    assert len(facts.library) == 200


def test_a_run_that_has_not_finished_is_refused(tmp_path, trained):
    copied = shutil.copytree(trained, tmp_path / "runs")
    folder = copied / "A2C" / "0"
    RunRecord.read(folder).updated(status="running").write(folder)
    nothing_is_left(tmp_path, OptionError, "0: contains an unfinished run", copied)
    RunRecord.read(folder).updated(status="finished").write(folder)
    (folder / "model.zip").unlink()
    nothing_is_left(tmp_path, OptionError, "0: contains an unfinished run", copied)


# --- what cannot be made leaves nothing --------------------------------------------------------


def nothing_is_left(tmp_path, error, match, *runs, **kwargs):
    home = tmp_path / "home"
    with pytest.raises(error, match=match):
        made(home / "bundle", *runs, **kwargs)
    assert not home.exists() or list(home.iterdir()) == []


def test_runs_on_other_specs_are_named(tmp_path, table):
    rows = [{**row(A0, None, seed), "spec": "SME/Default-v1"} for seed in range(7)]
    name = SMESpec().content_name
    nothing_is_left(
        tmp_path,
        Rejection,
        rf"unknown_spec: .*runs.json, run 0 \({name}\).* and 2 more: .* 3 instances "
        r"of two-v1 \(`sme show two`\)",
        rewritten(table, rows),
    )


@pytest.mark.parametrize(
    ("rows", "error", "match"),
    [
        ([row(A0, "a0.onnx"), row(A0, None)], Rejection, "duplicate_run: .*same spec and seed"),
        (
            [row(A0, "a0.onnx"), row(A0, "a0.onnx", 1), row(A1, None), row(B0, None)],
            Rejection,
            "duplicate_run: .*same spec and policy",
        ),
        ([row(A0, "a0.onnx")], Rejection, "missing_run: runs: none on"),
        ([], SpecError, "runs"),
        ({"spec": 1}, SpecError, "must be a list of runs"),
        ([{"spec": A0.digest, "policy": None, "steps": 1}], SpecError, "run 0: seed: missing"),
        ([{**row(A0, None), "step": 1}], SpecError, "step=1: unknown field. Did you mean 'steps'"),
        ([row(A0, None, seed=-1)], SpecError, "seed=-1"),
        ([{**row(A0, None), "spec": "SME/Defalt-v1"}], SpecError, "run 0: .*Did you mean"),
        ([{**row(A0, None), "spec": "absent.json"}], SpecError, "run 0: .*absent.json"),
        ([row(A0, "a0.pt")], SpecError, "policy='a0.pt': must be the path of an .onnx"),
        ([row(A0, "absent.onnx"), row(A1, None), row(B0, None)], OptionError, "cannot be read"),
        ([row(A0, "absent.zip"), row(A1, None), row(B0, None)], PolicyError, "does not exist"),
        (
            [row(A0, None), row(A1, None), row(B0, "a0.onnx")],
            Rejection,
            r"onnx_interface: .*runs.json, run 2: ",
        ),
    ],
)
def test_a_table_that_is_wrong_is_refused(tmp_path, table, rows, error, match):
    nothing_is_left(tmp_path, error, match, rewritten(table, rows))


def test_a_policy_above_the_limit_is_refused(tmp_path, table):
    with (table.parent / "a1.onnx").open("r+b") as stream:
        stream.truncate(2**40)
    nothing_is_left(tmp_path, Rejection, "too_large: .*runs.json, run 1", table)


@pytest.mark.parametrize("path", ["absent", "absent.json", "empty"])
def test_a_path_that_is_no_run_is_refused(tmp_path, path):
    (tmp_path / "empty").mkdir()
    nothing_is_left(tmp_path, OptionError, f"runs='.*{path}': must be", tmp_path / path)


@pytest.mark.parametrize(
    ("fields", "error", "match"),
    [
        ({"method": "<b>"}, Rejection, "unsafe_name: method.name"),
        ({"submitter": ""}, SpecError, "submitter.name=''"),
        (
            {"code": "http://plain.org"},
            SpecError,
            "code='http://plain.org': must be an https:",
        ),
        ({"code": 3}, SpecError, "code=3: must be an https:// link"),
        ({"code": "https://a b"}, SpecError, "code='https://a b': must be an https:// link"),
        ({"code": "https://" + "a" * 293}, SpecError, "code='https://a+…: must be .* at most 300"),
        ({"runs_started": {"C": 1}}, Rejection, "missing_run: runs_started.C"),
        ({"runs_started": {"A": 1}}, Rejection, "missing_run: runs_started.A=1"),
        ({"knowledge": "all"}, SpecError, "knowledge='all'"),
    ],
)
def test_what_the_board_would_refuse_is_refused_before_exporting(
    tmp_path, table, fields, error, match
):
    seen = []
    nothing_is_left(
        tmp_path, error, match, table, progress=lambda *counts: seen.append(counts), **fields
    )
    assert seen == []


def test_a_submission_of_too_many_runs_is_refused_before_exporting(tmp_path, table):
    rows = [row(spec, "a0.onnx", seed) for spec in SUITE.instances for seed in range(200)]
    seen = []
    nothing_is_left(
        tmp_path,
        Rejection,
        "too_large: submission.json: .* List fewer runs",
        rewritten(table, rows),
        progress=lambda *counts: seen.append(counts),
    )
    assert seen == []


def test_an_existing_bundle_is_replaced_only_with_force(tmp_path, table, bundle):
    with pytest.raises(OptionError, match="bundle already exists"):
        made(bundle.folder, table, method="Other")
    assert Bundle.read(bundle.folder) == bundle
    again = made(bundle.folder, table, method="Other", force=True)
    assert Bundle.read(bundle.folder).signed == again.signed != bundle.signed
    assert {path.name for path in tmp_path.iterdir()} == {"runs", "bundle"}


def test_a_bundle_that_was_there_stays_where_making_another_fails(table, bundle):
    (table.parent / "a1.onnx").write_bytes(b"no model")
    with pytest.raises(Rejection):
        made(bundle.folder, table, force=True)
    assert Bundle.read(bundle.folder) == bundle


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_what_is_no_bundle_is_never_replaced(tmp_path, table, bundle, kind):
    target = tmp_path / "mine"
    if kind == "folder":
        target.mkdir()
        (target / "thesis.tex").write_text("all of it")
    elif kind == "file":
        target.write_text("all of it")
    else:
        target.symlink_to(bundle.folder)
    with pytest.raises(OptionError, match="mine: is not a bundle, or contains other files"):
        made(target, table, force=True)
    assert target.is_symlink() == (kind == "link")
    assert Bundle.read(bundle.folder) == bundle
    assert kind != "folder" or (target / "thesis.tex").read_text() == "all of it"


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path, table):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SMEError, match="cannot be written"):
        made(tmp_path / "file" / "bundle", table)


def test_the_constant_policy_may_stand_for_two_instances_of_one_width(tmp_path, table):
    (table.parent / "half.onnx").write_bytes(constant_onnx(A0))
    rows = [row(A0, "half.onnx"), row(A1, "half.onnx"), row(B0, None)]
    bundle = made(tmp_path / "bundle", rewritten(table, rows))
    assert len(list((bundle.folder / "artefacts").iterdir())) == 1


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
    submission = Bundle.read(bundle.folder).signed.submission
    assert {run.spec for run in submission.runs} == {spec.digest for spec in SUITE.instances}
    assert all(run.steps >= 10 and run.artefact is not None for run in submission.runs)
    assert "stable_baselines3" in submission.training.library
    assert submission.training.hyperparameters.startswith("A2C, default hyperparameters")
    assert made(tmp_path / "same", study, algorithm="a2c").signed.submission.runs


def test_a_study_that_is_not_finished_or_has_no_such_algorithm_is_refused(tmp_path, study):
    with pytest.raises(OptionError, match=r"4 of 4 runs are not finished"):
        made(tmp_path / "bundle", study, algorithm="Other")
    with pytest.raises(OptionError, match=r"algorithm='TD3': .* has runs of A2C"):
        made(tmp_path / "bundle", study, algorithm="TD3")
    assert not (tmp_path / "bundle").exists()


def test_a_failed_run_of_a_study_is_submitted_without_a_policy(tmp_path, study):
    copy = tmp_path / "copy"
    shutil.copytree(study, copy)
    result = next((copy / "cells").iterdir())
    cell = CellResult.from_dict(json.loads(result.read_text()))
    failure = CellFailure(key=cell.key, cell=cell.cell, error="diverged", traceback="", versions={})
    (copy / "failed").mkdir(exist_ok=True)
    (copy / "failed" / result.name).write_text(json.dumps(failure.to_dict()))
    result.unlink()
    runs = made(tmp_path / "bundle", copy).signed.submission.runs
    failed = [run for run in runs if run.artefact is None]
    assert [(run.spec, run.seed) for run in failed] == [(cell.cell.spec.digest, cell.cell.seed)]


def test_a_study_without_models_is_refused(tmp_path, study):
    copy = tmp_path / "copy"
    shutil.copytree(study, copy)
    shutil.rmtree(copy / "models")
    with pytest.raises(OptionError, match="--keep-models"):
        made(tmp_path / "bundle", copy)


def test_an_algorithm_selects_among_the_folders_of_trained_runs(tmp_path, trained, failed):
    with pytest.raises(Rejection, match=f"missing_run: runs: none on {A0.digest}.*policy null"):
        made(tmp_path / "bundle", trained, failed, algorithm="TD3")
    assert made(tmp_path / "bundle", trained, failed, algorithm="a2c")


def test_a_run_that_is_listed_twice_is_named_by_its_source(tmp_path, trained, failed):
    with pytest.raises(Rejection, match=r"A2C/0: seed=3: .*A2C/0 has the same"):
        made(tmp_path / "bundle", trained, trained, failed)
