"""The leaderboard's errors.

    SMEError
    ├── Rejection            a submission or an artefact is rejected; has a stable `code`
    ├── BoardError           a folder holds no board, a key is missing, a file is not writable, …
    │   ├── ClockError           the machine's clock is wrong, so nothing is written
    │   ├── ScoringFault     the machine could not score; says nothing about the submission
    │   └── NotPublishable   the reference rows do not score 0 and 1, so no score is shown
    └── TamperedError        a board's files contradict its signed log; names the first such row

A rejection's message has the form `code: field=value: what is allowed. What to do.` The codes are
part of the interface: scripts may test them, so a released code keeps its meaning.
"""

from __future__ import annotations

from sme_registry.errors import SMEError

CODES = {
    # the document
    "not_json": "the submission is not strict UTF-8 JSON, or nested too deeply",
    "schema": "a field is invalid, missing or unknown",
    "too_large": "the submission or an artefact is larger than the limit",
    "bad_signature": "the signature is missing, or does not match the document and the key",
    "wrong_board": "the signature is for another board or address, or for none",
    "stale_time": "the submission's time differs too much from the board's",
    "unknown_suite": "the suite, protocol or track is not the board's",
    "unknown_spec": "a run's spec digest is not an instance of the suite",
    "duplicate_run": "a run, or an artefact within one spec, is listed twice",
    "missing_run": "an instance has no run, no run has a policy, or runs_started is too small",
    "unsafe_name": "a name or path has forbidden characters, or is reserved for the board",
    "name_taken": "another key has used this name on this board",
    "unknown_submission": "no submission on the board has this id",
    "withdrawn": "the submission was withdrawn by its submitter",
    "quota": "the key's, or the board's, quota is used up",
    # a sealed season
    "season_unknown": "no season on the board has this id or digest",
    "season_track": "the season takes entries, and not tickets, or the reverse",
    "season_not_open": "the season has not opened yet",
    "season_closed": "the season is closed",
    "season_not_closed": "the season is not over or not revealed, so its tasks are still secret",
    "season_revealed": "the season's tasks are public",
    "not_admitted": "the season takes listed keys only, and the organiser has not listed this one",
    "reveal_mismatch": "the master does not match the season's commitment",
    "ticket_unknown": "the season has no ticket of this number",
    "ticket_ended": "the ticket's deadline has passed, or all of it is answered",
    "ticket_limit": "as many tickets of the key, or of all keys, were started as the season allows",
    "token_wrong": "the request does not have the ticket's token",
    "instance_unknown": "the ticket has no instance of this number",
    "instance_phase": "the instance is not started yet, still stepped, or answered",
    "lanes_invalid": "the number of lanes is outside the allowed range",
    "start_conflict": "the instance was started with another number of lanes",
    "step_invalid": "the actions of a step have a wrong shape, or are not finite",
    "step_conflict": "the steps of this number were taken with other actions, or long ago",
    "step_ahead": "steps before these have not been taken",
    "budget_spent": "the instance's budget does not suffice for a step of all lanes",
    "answer_conflict": "other answers for this instance are stored",
    "storage_full": "the board's disk is full, or fails; nothing was changed",
    "answer_shape": "an answer is no .npy file of float32 actions of the expected shape",
    "answer_not_finite": "an answer contains NaN or an infinity",
    "answer_missing": "an entry has another number of answers than the season has instances",
    # the artefact, from its bytes
    "artefact_missing": "a run's artefact has not been uploaded, or is not in the bundle",
    "artefact_digest": "an artefact's bytes or size differ from the submission",
    "artefact_path": "an artefact's path leaves its folder, or is not a plain file",
    "onnx_malformed": "the bytes are not an ONNX model",
    "onnx_version": "the opset or IR version is outside the allowed range",
    "onnx_domain": "an operator domain other than ONNX's",
    "onnx_op": "an operator that is not allowed",
    "onnx_subgraph": "a subgraph, function, or training information",
    "onnx_external_data": "tensor data in another file",
    "onnx_tensor": "a tensor that is sparse, too large, or of a wrong type or length",
    "onnx_too_many_nodes": "more nodes, tensors or attributes than the limit",
    "onnx_interface": "a wrong number, type or width of inputs or outputs",
    # the artefact, run
    "onnx_refused": "onnxruntime cannot load the model",
    "run_failed": "the model fails while it runs",
    "run_output": "the model's actions have a wrong shape or type",
    "run_not_finite": "an action is NaN or infinite",
    "run_batch_dependent": "an action depends on the other rows of its batch",
    "run_rounding": "the actions change if observations change by one unit in the last place",
    "run_repeated": "two runs on one instance have the same policy, up to small differences",
    "run_time": "the model exceeds the limit on processor or wall time",
    "run_memory": "the model exceeds the limit on memory",
    "scoring_failed": "scoring failed several times for an unknown reason",
}


_MAX_MESSAGE = 2000


class Rejection(SMEError):
    """A submission or an artefact is rejected, for the reason of a code in `CODES`."""

    def __init__(self, code: str, message: str) -> None:
        if code not in CODES:
            raise ValueError(f"unknown code: {code!r}")
        if len(message) > _MAX_MESSAGE:  # who sends a document may not choose the answer's length
            message = message[: _MAX_MESSAGE - 1] + "…"
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message

    def __reduce__(self) -> tuple[type[Rejection], tuple[str, str]]:
        return type(self), (self.code, self.message)


class BoardError(SMEError):
    """A folder holds no board, a key is missing, or the board cannot be read or written."""


class ClockError(BoardError):
    """The machine's clock is behind the log, or has jumped: nothing is written until it is set."""


class ScoringFault(BoardError):
    """The machine could not score a submission, which is not judged and keeps waiting."""


class NotPublishable(BoardError):
    """A reference row is missing, waits or does not score 0 or 1, so no score is shown."""

    def __init__(self, message: str, *, waiting: bool = False) -> None:
        super().__init__(message)
        self.waiting = waiting


class TamperedError(SMEError):
    """A board's files contradict its signed log, first in the file or value `where`."""

    def __init__(self, where: str, message: str) -> None:
        super().__init__(f"{where}: {message}")
        self.where = where
        self.message = message

    def __reduce__(self) -> tuple[type[TamperedError], tuple[str, str]]:
        return type(self), (self.where, self.message)
