"""`fetch`: what a copy has, how it goes on, and what a server cannot make it write."""

import shutil

import pytest

from leaderboard.documents.board import hex_of
from leaderboard.documents.signed import SigningKey
from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.verify import verify
from leaderboard.seasons.publication import files_of_seasons
from leaderboard.seasons.store import SeasonStore
from leaderboard.store import Store
from leaderboard.web.client import ServedBoard, _Copy, fetch
from sme_registry.io import sha256_of
from tests.leaderboard.conftest import EXAMPLE, SEASONS
from tests.leaderboard.seasons.sealing import findings_of
from tests.leaderboard.serving import serving


@pytest.fixture
def url(tmp_path):
    board = shutil.copytree(EXAMPLE, tmp_path / "served")
    with serving(board) as url:
        yield url


def files(folder):
    return {
        path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def test_a_copy_has_all_that_is_public_and_is_verified(url, tmp_path):
    fetched = fetch(url, tmp_path / "copy")
    assert fetched.entries == 9
    assert files(tmp_path / "copy") == files(EXAMPLE)
    assert verify(tmp_path / "copy", rescore=1).is_confirmed
    again = fetch(url, tmp_path / "copy")
    assert (again.entries, again.files) == (9, 0)


def test_it_goes_on_after_every_interruption(url, tmp_path, monkeypatch):
    real, copy = ServedBoard.read, tmp_path / "copy"
    for count in range(40):
        left = [count]

        def read(self, *arguments, left=left, **named):
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return real(self, *arguments, **named)

        monkeypatch.setattr(ServedBoard, "read", read)
        try:
            fetch(url, copy)
            break
        except KeyboardInterrupt:
            if count > 3:  # what is there is a board
                Store.open(copy, read_only=True).close()
    assert count > 5
    assert files(copy) == files(EXAMPLE)


def answering(monkeypatch, change):
    """The server's answers to requests for bytes, changed."""
    real = ServedBoard.read

    def read(self, method, path, *arguments, **named):
        return change(path, real(self, method, path, *arguments, **named))

    monkeypatch.setattr(ServedBoard, "read", read)


def test_what_a_server_alters_is_refused_and_not_written(url, tmp_path, monkeypatch):
    board = Store.open(EXAMPLE, read_only=True)
    with board, monkeypatch.context() as patch:
        document = board.log(1, 1)[0].document
        name = f"/api/objects/{hex_of(document)}"
        answering(patch, lambda path, data: data + b" " if path == name else data)
        with pytest.raises(BoardError, match="has another digest"):
            fetch(url, tmp_path / "one")
        with Store.open(tmp_path / "one", read_only=True) as copy:
            assert copy.head.sequence == 0
    for old, new in ((b"received", b"withdrawn"), (b'"sequence":3', b'"sequence":4')):
        with monkeypatch.context() as patch:
            answering(patch, lambda path, data, a=old, b=new: data.replace(a, b))
            with pytest.raises(TamperedError, match=r"signature|does not follow"):
                fetch(url, tmp_path / new.decode()[-3:].strip(":"))


def test_a_limit_and_another_boards_folder_stop_it(url, tmp_path, monkeypatch):
    with pytest.raises(BoardError, match=r"more than 10,000 bytes"):
        fetch(url, tmp_path / "copy", most=10_000)
    with monkeypatch.context() as patch:
        answering(patch, lambda path, data: data + b" " * 10**6 if "/log?" in path else data)
        with pytest.raises(BoardError, match=r"more than 1,000,000 bytes"):
            fetch(url, tmp_path / "copy", most=10**6)
    fetch(url, tmp_path / "copy")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("")
    other = shutil.copytree(SEASONS, tmp_path / "other")
    own = shutil.copytree(EXAMPLE, tmp_path / "own")
    SigningKey.generate().write(own / "board.key")
    for folder, match in ((tmp_path / "full", "not empty"), (other, "no copy"), (own, "no copy")):
        before = files(folder)
        with pytest.raises(BoardError, match=match):
            fetch(url, folder)
        assert files(folder) == before


@pytest.fixture
def seasons(tmp_path):
    board = shutil.copytree(SEASONS, tmp_path / "served")
    with serving(board) as url:
        yield url


def test_seasons_are_copied_with_what_was_played_and_verified(seasons, tmp_path):
    copy = tmp_path / "copy"
    fetch(seasons, copy, board=SeasonStore, parts=[files_of_seasons])
    played = {path for path in files(copy) if path.suffix in (".journal", ".npy")}
    assert played == {path for path in files(SEASONS) if path.suffix in (".journal", ".npy")}
    with SeasonStore.open(copy, read_only=True) as store:
        findings = findings_of(store)
    assert findings.notes == []
    counts = {row.what: row.checked for row in findings.rows if "scored again" in row.what}
    assert counts == {"winter: results, scored again": 5, "autumn: results, scored again": 6}
    # Autumn's data sets are not committed; another processor may round them otherwise.
    [data] = [row for row in findings.rows if "data sets" in row.what]
    assert data.checked + data.unchecked == 6
    assert len(verify(copy, board=SeasonStore).missing) == 6  # which the board itself lacks


def test_files_of_policies_may_be_missing_and_nothing_else_about_them(seasons, tmp_path):
    copy = tmp_path / "copy"
    fetch(seasons, copy, board=SeasonStore)
    name = sha256_of(b"policy")
    with ServedBoard(seasons) as served:
        begun = _Copy(served, copy, most=10**6, progress=lambda what: None)
        begun.fetch_object(name, optional=True)
        with pytest.raises(BoardError, match="nothing exists at this address"):
            begun.fetch_object(name)
        served.read = lambda *_, **__: b"policy"
        begun = _Copy(served, copy, most=3, progress=lambda what: None)
        with pytest.raises(BoardError, match="has sent more than 3 bytes"):
            begun.fetch_object(name, optional=True)

        def fault(*_, **__):
            raise BoardError("gives no answer")

        served.read = fault
        with pytest.raises(BoardError, match="gives no answer"):
            begun.fetch_object(name, optional=True)


ENDLESS = b'{"files": [{"path": "a", "size": 1e999}], "next": null}'


@pytest.mark.parametrize(
    ("answer", "match"),
    [
        (lambda path, data: b"" if "/files/" in path else data, "another size"),
        (lambda path, data: data + b"x" if "/files/" in path else data, "another size"),
        (lambda path, data: data[:1] if "/files/" in path else data, "another size"),
        (lambda path, data: b"[]" if "/files?" in path else data, "list of files is invalid"),
        (lambda path, data: ENDLESS if "/files?" in path else data, "list of files is invalid"),
        (lambda path, data: data.replace(b'"title"', b'"x"'), "definition is invalid"),
        (lambda path, data: data.replace(b'"draws": 10000', b'"draws": 999'), "another board"),
    ],
)
def test_a_server_that_contradicts_itself_is_refused(seasons, tmp_path, monkeypatch, answer, match):
    answering(monkeypatch, answer)
    with pytest.raises(BoardError, match=match):
        fetch(seasons, tmp_path / "copy", board=SeasonStore, parts=[files_of_seasons])


@pytest.mark.parametrize("following", [0, 10**9])
def test_a_list_of_files_that_never_ends_ends(seasons, tmp_path, monkeypatch, following):
    asked = []

    def lie(path, data):
        if "/files?" not in path:
            return data
        asked.append(path)
        assert len(asked) < 9
        return b'{"files": [], "next": %d}' % (following and following + len(asked))

    answering(monkeypatch, lie)
    fetch(seasons, tmp_path / "copy", board=SeasonStore, parts=[files_of_seasons])
    assert len(asked) == 2  # one of each season


ODD = (
    "../up",
    "x" * 200,
    "/absolute",
    "tickets/../../up",
    ".stepping",
    "published/.a",
    "a//b",
    "published/evil.py",
    "other/run.sh",
    "tickets/999/0.npy",
)


@pytest.mark.parametrize("path", ODD)
def test_a_server_names_no_file_outside_the_copy(seasons, tmp_path, monkeypatch, path):
    def lie(address, data):
        listed = b'{"files": [{"path": "%s", "size": 3}], "next": null}'
        return listed % path.encode() if "/files?" in address else data

    answering(monkeypatch, lie)
    with pytest.raises(BoardError, match="which its log does not name"):
        fetch(seasons, tmp_path / "copy", board=SeasonStore, parts=[files_of_seasons])
