"""`Bundle`: a submission as a folder.

submission.json             the signed submission
artefacts/<64 hex>.onnx     each policy that it names, by the SHA-256 of its bytes
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from dataclasses import dataclass
from pathlib import Path

from leaderboard.documents.board import hex_of
from leaderboard.documents.signed import MAX_BYTES, Signed
from leaderboard.documents.submission import ARTEFACTS, FILE, MAX_ARTEFACT_BYTES, Submission
from leaderboard.errors import Rejection
from sme_registry.errors import OptionError
from sme_registry.io import sha256_of


@dataclass(frozen=True)
class Bundle:
    """A bundle whose signature is verified.

    Attributes:
      folder: its path.
      signed: the signed submission.
    """

    folder: Path
    signed: Signed[Submission]

    @classmethod
    def read(cls, folder: str | os.PathLike[str]) -> Bundle:
        """Read a bundle's submission. Artefacts are read on request.

        Raises:
          Rejection: `artefact_path` if the file is a link or not a regular file, and the codes of
            `Signed[Submission].read`.
          OptionError: the folder or its submission is missing.
        """
        folder = Path(folder)
        text = _read_regular(folder, (FILE,), MAX_BYTES)
        if text is None:
            raise OptionError(
                f"{folder}: contains no {FILE}. Create a bundle with `sme-leaderboard new`."
            )
        return cls(folder, Signed[Submission].read(text))

    def artefact(self, digest: str) -> bytes:
        """The bytes of an artefact that the submission names.

        Raises:
          Rejection: `artefact_missing`; `artefact_path` if the file or its folder is a link or not
            regular; `too_large`; or `artefact_digest` if hash or size differ.
        """
        sizes = {
            run.artefact.size
            for run in self.signed.content.runs
            if run.artefact is not None and run.artefact.sha256 == digest
        }
        if not sizes:
            raise Rejection(
                "artefact_missing", f"artefact={digest:.80}: no run of the submission names it."
            )
        name = f"{hex_of(digest)}.onnx"
        data = _read_regular(self.folder, (ARTEFACTS, name), MAX_ARTEFACT_BYTES)
        if data is None:
            raise Rejection(
                "artefact_missing",
                f"{ARTEFACTS}/{name}: is missing from the bundle. Add it, or recreate the bundle.",
            )
        if len(data) > MAX_ARTEFACT_BYTES:
            raise Rejection(
                "too_large",
                f"{ARTEFACTS}/{name}: must be at most {MAX_ARTEFACT_BYTES:,} bytes. Submit a "
                "smaller network.",
            )
        if sizes != {len(data)} or sha256_of(data) != digest:
            raise Rejection(
                "artefact_digest",
                f"{ARTEFACTS}/{name}: {len(data):,} bytes of {sha256_of(data)}: must be "
                f"{' and '.join(f'{size:,}' for size in sorted(sizes))} bytes of {digest}. "
                "Recreate the bundle.",
            )
        return data


def _read_regular(folder: Path, parts: tuple[str, ...], limit: int) -> bytes | None:
    """A regular file inside a folder, up to one byte above the limit; None if it does not exist.

    Each part of the path is opened relative to the one before and links are not followed, so that
    nothing outside the folder is read even if the folder changes meanwhile. Opening never blocks,
    so that a pipe is rejected. Systems without these calls (Windows) check the path instead.
    """
    name = "/".join(parts)
    refused = Rejection(
        "artefact_path",
        f"{name}: must be a regular file inside the bundle, not a link. Copy the file there.",
    )
    if os.open not in os.supports_dir_fd:
        path = folder.joinpath(*parts)
        if not os.path.lexists(path):
            return None
        if not path.is_file() or path.resolve() != folder.resolve().joinpath(*parts):
            raise refused
        with path.open("rb") as stream:
            return stream.read(limit + 1)
    with contextlib.ExitStack() as opened:
        try:
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            opened.callback(os.close, handle)
            for part in parts:
                kind = os.O_NONBLOCK if part == parts[-1] else os.O_DIRECTORY
                handle = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | kind, dir_fd=handle)
                opened.callback(os.close, handle)
        except FileNotFoundError:
            return None
        except OSError as error:
            if error.errno in (errno.ELOOP, errno.ENOTDIR, errno.ENXIO):
                raise refused from None
            raise OptionError(
                f"{folder / name}: cannot be read: {error.strerror}. Check its permissions."
            ) from None
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise refused
        with open(handle, "rb", closefd=False) as stream:
            return stream.read(limit + 1)
