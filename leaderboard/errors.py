"""What the leaderboard raises.

    SMEError
    ├── Rejection        a submission or an artefact is refused; has a stable `code`
    ├── BoardError       a folder is no board, a key is missing, a board cannot do this
    ├── TamperedError    a board's files do not agree with its signed log; has the first bad row
    └── NotPublishable   the reference rows leave 0 and 1, so no number of this board is shown

A rejection's message is of the form `code: field=value: what is allowed. What to do.` The codes
are part of the interface: scripts may test them, so one that is released keeps its meaning.
"""

from __future__ import annotations

from sme_registry.errors import SMEError

CODES = {
    # the document
    "not_json": "the submission is not strict UTF-8 JSON, or nested too deeply",
    "schema": "a field is wrong, missing or unknown",
    "too_large": "the submission or an artefact is larger than the limit",
    "bad_signature": "the signature is missing, or not of this document by this key",
    "stale_time": "the submission's time is too far from the board's",
    "unknown_suite": "the suite, protocol or track is not this board's",
    "unknown_spec": "a run's spec digest is no instance of the suite",
    "duplicate_run": "a run, or an artefact within one spec, is listed twice",
    "missing_run": "an instance of the suite has no run, or runs_started is below the runs listed",
    "unsafe_name": "a name or path holds characters that are not allowed, or is the board's own",
    "unknown_submission": "no submission of this id is on the board",
    "withdrawn": "the submission was withdrawn by its submitter",
    "quota": "the key's, or the board's, quota is used up",
    # the artefact, from its bytes
    "artefact_missing": "an artefact that a run names has not been uploaded or is not beside it",
    "artefact_digest": "an artefact's bytes or size are not what the submission says",
    "artefact_path": "an artefact's path leaves its folder, or is a link or no plain file",
    "onnx_malformed": "the bytes are not the protobuf of an ONNX model",
    "onnx_version": "the opset or IR version is outside the range",
    "onnx_domain": "an operator domain other than ONNX's own",
    "onnx_op": "an operator outside the list",
    "onnx_subgraph": "a subgraph, function, or training information",
    "onnx_external_data": "data outside the file",
    "onnx_tensor": "a tensor that is sparse, too large, of another type, or not as long as it says",
    "onnx_too_many_nodes": "more nodes, tensors or attributes than the limit",
    "onnx_interface": "inputs or outputs of another count, type or width",
    # the artefact, run
    "onnx_refused": "onnxruntime refuses to load the model",
    "run_failed": "the model fails while it runs",
    "run_output": "the model's actions have another shape or type",
    "run_not_finite": "an action is NaN or infinite",
    "run_batch_dependent": "an action depends on the other rows of its batch",
    "run_time": "the model takes more processor or wall time than the limit",
    "run_memory": "the model takes more memory than the limit",
    "scoring_failed": "scoring failed several times for no reason found in the submission",
}


class Rejection(SMEError):
    """A submission or an artefact is refused.

    Args:
      code: one of `CODES`.
      message: field, value, what is allowed, what to do.
    """

    def __init__(self, code: str, message: str) -> None:
        if code not in CODES:
            raise ValueError(f"no such code: {code!r}")
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message

    def __reduce__(self) -> tuple[type[Rejection], tuple[str, str]]:
        return type(self), (self.code, self.message)


class BoardError(SMEError):
    """A folder is no board, a key is missing, or the board cannot do what is asked."""


class NotPublishable(BoardError):
    """The reference rows are missing or leave 0 and 1; nothing of this board is shown."""


class TamperedError(SMEError):
    """A board's files do not agree with its signed log.

    Args:
      where: the first altered row, such as `log/00000007.json`.
      message: what is wrong with it.
    """

    def __init__(self, where: str, message: str) -> None:
        super().__init__(f"{where}: {message}")
        self.where = where
        self.message = message

    def __reduce__(self) -> tuple[type[TamperedError], tuple[str, str]]:
        return type(self), (self.where, self.message)
