"""The pages of a board, each a function of the store; `write_site` writes them all.

    index.html, ood_regret.html, ood_decay.html    the board by each metric
    submissions/<64 hex>.html, .json    of each submission; results/<64 hex>.json
    compare.html, board-data.js         chosen entries over one another, drawn by static/board.js
    log.html, log-<n>.html              the log, `LOG_ROWS` entries a page, and how to verify
    method.html                         the formulas
    board.json, .csv, .tex              the board by N₀ as data; so are ood_regret.*, ood_decay.*

Whatever a submitter wrote is escaped by Jinja2, which does so for every value that is not marked
as safe; marked are only the drawings, which hold numbers and what they escaped themselves.
"""

from __future__ import annotations

import itertools
import json
import re
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

from leaderboard import exports
from leaderboard.documents.board import Folder, hex_of
from leaderboard.documents.result import Estimate, Result, RunScore
from leaderboard.documents.submission import Run, SignedSubmission, Submission
from leaderboard.errors import CODES
from leaderboard.scoring import ranking
from leaderboard.store import EntryRow, Store
from leaderboard.store.files import write_file
from leaderboard.web.site import charts
from sme_registry.errors import MissingDependencyError, OptionError

try:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup
except ImportError:
    raise MissingDependencyError(
        "The pages need Jinja2, which is not installed. "
        "Install it with `pip install 'sme-registry[leaderboard]'`."
    ) from None

STATIC = Path(__file__).parent / "static"
LOG_ROWS = 200  # of a page of the log; a page that is full never changes again
SHORT = 16  # hex digits of an id in an address: enough that nobody can make two of them meet
_WRITERS = 8  # threads that wait for the disk

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".csv": "text/csv; charset=utf-8",
    ".tex": "text/plain; charset=utf-8",
    ".svg": "image/svg+xml",
}

_TABLES = {"json": exports.to_json, "csv": exports.to_csv, "tex": exports.to_latex}
_LOG_PAGE = re.compile(r"log-(0|[1-9][0-9]{0,8})\.html")

MetricKey = Literal["wd_regret", "ood_regret", "ood_decay"]


@dataclass(frozen=True)
class Metric:
    """A tab of the board.

    Attributes:
      key: of the score.
      page: the file.
      stem: of the files that hold the same as data.
      symbol, label, hint, text: what it is called and means, short to long.
      references: class name and value of each reference row, as lines in the drawings.
    """

    key: MetricKey
    page: str
    stem: str
    symbol: str
    label: str
    hint: str
    text: str
    references: tuple[tuple[str, float], ...] = (("optimal", 0.0), ("constant", 1.0))


METRICS = (
    Metric(
        "wd_regret",
        "index.html",
        "board",
        "N₀",
        "WD regret N₀",
        "inside the training cube",
        "Mean distance to the optimal action inside the training cube, as a share of the constant "
        "policy's: 0 is optimal, 1 is no better than always answering ½.",
    ),
    Metric(
        "ood_regret",
        "ood_regret.html",
        "ood_regret",
        "N̄",
        "OOD regret N̄",
        "beyond the training cube",
        "The same share, averaged over the shells around the training cube: how good the policy "
        "still is in states that training never shows.",
    ),
    Metric(
        "ood_decay",
        "ood_decay.html",
        "ood_decay",
        "N̄ − N₀",
        "OOD decay N̄ − N₀",
        "what is lost on the way out",
        "The OOD regret minus the WD regret: how much of what was learned inside the training cube "
        "is lost outside. 0 is no loss; a negative value is a gain.",
        (("optimal", 0.0), ("constant", 0.0)),
    ),
)


@dataclass(frozen=True)
class _Line:
    """A row of the board as the template shows it; drawings and numbers are made already."""

    entry: EntryRow
    hex: str
    short: str
    first: int | str
    rank: str
    value: str
    low: str
    high: str
    estimate: Estimate
    bar: str
    spark: str
    steps: str
    code_link: str | None
    flags: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class _RunLine:
    """A run as submitted and as scored; either may be missing."""

    class_name: str
    spec: str | None
    artefact: str | None
    run: Run | None
    score: RunScore | None


class Pages:
    """The pages of a board as it is now; make another once its log has grown.

    Args:
      store: an open store; read only.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self.document = store.document
        self._kept: tuple[str, tuple[SignedSubmission, Result | None]] | None = None

    @cached_property
    def entries(self) -> list[EntryRow]:
        """Every entry of the board.

        Raises:
          NotPublishable: the reference rows are missing or leave 0 and 1.
        """
        entries = self.store.entries()
        ranking.refuse_unpublishable(entries)
        return entries

    def board(self, metric: MetricKey = "wd_regret") -> str:
        """The board by a metric.

        Raises:
          NotPublishable: as `entries` says; likewise of every other page.
        """
        tab = next(tab for tab in METRICS if tab.key == metric)
        rows = ranking.ranking(self.entries, metric)
        scores = [row.entry.scores for row in rows if row.entry.scores]
        shown: list[Estimate] = [getattr(score, metric) for score in scores]
        ends = [end for estimate in shown for end in (estimate.low, estimate.high)]
        scale = charts.Scale.of([*ends, *(value for _, value in tab.references)])
        marks = charts.reference_lines(scale, tab.references)
        spark = charts.Scale.of(
            [0.0, 1.0, *(e.value for score in scores for e in score.normalised_regret)]
        )
        lines = [self._line(row, tab, scale, marks, spark) for row in rows if row.entry.scores]
        ranked = [line for line in lines if line.rank and not line.entry.reference]
        competing = [entry for entry in self.entries if not entry.reference]
        others = [entry for entry in competing if entry.status != "scored"]
        return self._render(
            "board.html",
            here="index.html",
            title=tab.label,
            metric=tab,
            metrics=METRICS,
            head=self.store.head,
            instances=sum(len(member.seeds) for member in self.document.suite.classes),
            entrants=len(competing),
            references=[line for line in lines if line.entry.reference],
            ranked=ranked,
            listed=[line for line in lines if not line.rank and not line.entry.reference],
            others=[
                {"entry": entry, "hex": hex_of(entry.id)}
                for entry in sorted(others, key=lambda entry: -entry.sequence)
            ],
            families=sorted({line.entry.family for line in lines if not line.entry.reference}),
            knowledges=sorted({line.entry.knowledge for line in lines if not line.entry.reference}),
            axis=charts.bar_axis(scale, tab.references),
        )

    def submission(self, id: str) -> str:
        """The page of a submission: waiting, scored, rejected or withdrawn.

        Raises:
          KeyError: there is no such submission.
        """
        entry = self._by_id[id]
        signed, result = self._documents(id)
        withdrawal = self.store.withdrawal(id)
        submission = signed.submission
        digits = hex_of(id)
        scores = result.scores if result is not None else None
        edges = self.document.protocol.edges
        chart: str = ""
        classes: list[tuple[object, str]] = []
        if result is not None and scores is not None:
            chart = charts.profile_chart(
                scores.normalised_regret, edges, "profile", submission.method.name
            )
            scale = charts.Scale.of(
                [0.0, 1.0, *(n for c in result.classes for n in c.normalised_regret)]
            )
            classes = [(c, charts.sparkline(c.normalised_regret, scale)) for c in result.classes]
        return self._render(
            "submission.html",
            here="",
            root="../",
            title=f"{submission.method.name} {submission.method.version}",
            metrics=METRICS,
            id=id,
            hex=digits,
            short=digits[:SHORT],
            s=submission,
            result=result,
            status=entry.status,
            reason=withdrawal.withdrawal.reason if withdrawal is not None else "",
            reference=entry.reference,
            received=entry.received,
            sequence=entry.sequence,
            steps=sum(run.steps for run in submission.runs),
            code_link=_https(submission.code),
            codes=CODES,
            chart=chart,
            classes=classes,
            regions=charts.region_labels(edges),
            runs=self._runs(submission, result),
        )

    def compare(self) -> str:
        """The page on which `board.js` lays chosen entries over one another."""
        return self._render("compare.html", here="compare.html", title="Compare entries")

    def log(self, page: int | None = None) -> str:
        """A page of the log, with the words on how to verify it.

        Args:
          page: 0 for the oldest entries; None for the newest page.

        Raises:
          KeyError: there is no such page.
        """
        last = self.store.head[0]
        count = last // LOG_ROWS + 1
        page = count - 1 if page is None else page
        if not 0 <= page < count:
            raise KeyError(page)
        return self._render(
            "log.html",
            here="log.html",
            title="Log and verification",
            head=self.store.head,
            rows=[
                {"entry": entry, "hex": hex_of(entry.subject) if entry.event != "opened" else ""}
                for entry in self.store.log(page * LOG_ROWS, LOG_ROWS)
            ],
            page=page,
            pages=[
                (n, _log_page(n), n * LOG_ROWS, min((n + 1) * LOG_ROWS - 1, last))
                for n in range(count)
            ],
        )

    def method(self) -> str:
        """The page of formulas."""
        return self._render(
            "method.html",
            here="method.html",
            title="Method",
            regions=charts.region_labels(self.document.protocol.edges),
        )

    def data_js(self) -> str:
        """`board-data.js`: what the comparison draws. A script, since a file cannot be fetched."""

        def rounded(estimate: Estimate) -> list[float]:
            return [round(x, 5) + 0.0 for x in (estimate.value, estimate.low, estimate.high)]

        keys = ("wd_regret", "ood_regret", "ood_decay", "regret_slope", "similarity_loss")
        data = {
            "regions": charts.region_labels(self.document.protocol.edges),
            "metrics": [
                "WD regret N₀",
                "OOD regret N̄",
                "OOD decay N̄ − N₀",
                "Regret slope",
                "Similarity loss",
            ],
            "entries": [
                {
                    "id": hex_of(entry.id),
                    "name": f"{entry.method} {entry.version}",
                    "by": entry.submitter,
                    "scores": [rounded(getattr(entry.scores, key)) for key in keys],
                    "normalised_regret": [
                        rounded(estimate) for estimate in entry.scores.normalised_regret
                    ],
                }
                for entry in self.entries
                if entry.scores is not None and entry.status == "scored"
            ],
        }
        return f"window.boardData = {json.dumps(data, separators=(',', ':'))};\n"

    def read(self, path: str) -> bytes | None:
        """A file of the site by its path below the site's root, such as `ood_regret.html`.

        Raises:
          NotPublishable: as `entries` says.
        """
        folder, _, name = path.rpartition("/")
        if folder == "static":
            return _static().get(name)
        self.entries  # noqa: B018  nothing is shown of a board that refuses
        if folder in ("submissions", "results"):
            return self._document(folder, name)
        if folder:
            return None
        return self._page(name)

    def paths(self) -> Iterator[str]:
        """The paths of all files of the site; `index.html` last, so that it never leads nowhere."""
        yield from (f"static/{name}" for name in _static())
        for entry in self.entries:
            digits = hex_of(entry.id)
            yield f"submissions/{digits}.json"
            if entry.scores is not None or entry.code:
                yield f"results/{digits}.json"
            yield f"submissions/{digits}.html"
        for number in range(self.store.head[0] // LOG_ROWS + 1):
            yield _log_page(number)
        yield "board-data.js"
        yield from (f"{tab.stem}.{kind}" for tab in METRICS for kind in _TABLES)
        yield from ("log.html", "method.html", "compare.html", "ood_decay.html", "ood_regret.html")
        yield "index.html"

    def _page(self, name: str) -> bytes | None:
        for tab in METRICS:
            if tab.page == name:
                return self.board(tab.key).encode()
        makers: dict[str, Callable[[], str]] = {
            "compare.html": self.compare,
            "method.html": self.method,
            "log.html": self.log,
            "board-data.js": self.data_js,
        }
        if name in makers:
            return makers[name]().encode()
        stem, _, kind = name.rpartition(".")
        for tab in METRICS:
            if (tab.stem, kind in _TABLES) == (stem, True):
                rows = ranking.ranking(self.entries, tab.key)
                # Dated by the log, not by the clock: the same board gives the same bytes.
                (last,) = self.store.log(self.store.head[0], 1)
                table = _TABLES[kind](rows, tab.key, self.document, self.store.head[:2], last.time)
                return table.encode()
        number = _LOG_PAGE.fullmatch(name)
        try:
            return self.log(int(number[1])).encode() if number else None
        except KeyError:
            return None

    def _document(self, folder: str, name: str) -> bytes | None:
        digits, _, kind = name.partition(".")
        id = f"sha256:{digits}"
        if id not in self._by_id:
            return None
        if kind == "html" and folder == "submissions":
            return self.submission(id).encode()
        if kind != "json":
            return None
        _, result = self._documents(id)
        if folder == "submissions":
            return self.store.folder.submission(id).read_bytes()  # which the store has verified
        return self.store.folder.result(id).read_bytes() if result is not None else None

    def _documents(self, id: str) -> tuple[SignedSubmission, Result | None]:
        """A submission and its result; kept until others are asked for: three files need them."""
        kept = self._kept  # at once: a server's threads share these pages
        if kept is None or kept[0] != id:
            kept = self._kept = id, (self.store.submission(id), self.store.result(id))
        return kept[1]

    @cached_property
    def _by_id(self) -> dict[str, EntryRow]:
        return {entry.id: entry for entry in self.entries}

    @cached_property
    def _digests(self) -> dict[str, str]:
        """Of the board's documents: each is hashed anew whenever it is asked for."""
        document = self.document
        return {
            "board": document.digest,
            "suite": document.suite.digest,
            "protocol": document.protocol.digest,
        }

    @cached_property
    def _class_of(self) -> dict[str, str]:
        return {digest: name for digest, (name, _) in self.document.instances.items()}

    def _runs(self, submission: Submission, result: Result | None) -> list[_RunLine]:
        """The runs as submitted, each with what was computed of it, and then the missing ones.

        A result lists runs in the submission's order, and after them those that are not listed.
        """
        lines = []
        for run, score in itertools.zip_longest(
            submission.runs, result.runs if result is not None else ()
        ):
            if run is None:
                lines.append(_RunLine(score.class_name, None, None, None, score))
                continue
            name = self._class_of.get(run.spec, "not of this suite")
            artefact = run.artefact.sha256 if run.artefact is not None else None
            lines.append(_RunLine(name, run.spec, artefact, run, score))
        return lines

    def _render(self, template: str, **values: Any) -> str:
        common = {
            "root": "",
            "document": self.document,
            "digests": self._digests,
            "learned": ranking.LEARNED,
        }
        return _environment().get_template(template).render({**common, **values})

    def _line(
        self,
        row: ranking.RankedRow,
        tab: Metric,
        scale: charts.Scale,
        marks: Markup,
        spark: charts.Scale,
    ) -> _Line:
        entry = row.entry
        assert entry.scores is not None  # whoever is called has asked
        estimate: Estimate = getattr(entry.scores, tab.key)
        digits = hex_of(entry.id)
        code_link = _https(entry.code_link)
        flags = []
        if entry.oracle_like and not entry.reference:
            asked = "" if code_link else ": code asked for"
            flags.append(("warn", f"oracle-like{asked}"))
        if row.reason == ranking.TOO_FEW_RUNS:
            flags.append(("", f"fewer than {self.document.runs_to_rank} runs in a class"))
        elif row.reason and not entry.reference:
            flags.append(("", row.reason))
        return _Line(
            entry=entry,
            hex=digits,
            short=digits[:SHORT],
            first=row.first if row.first is not None else "",
            rank=_rank(row.first, row.last),
            value=charts.number(estimate.value),
            low=charts.number(estimate.low),
            high=charts.number(estimate.high),
            estimate=estimate,
            bar=charts.interval_bar(estimate, scale, marks),
            spark=charts.sparkline([e.value for e in entry.scores.normalised_regret], spark),
            steps=steps_text(entry.steps),
            code_link=code_link,
            flags=tuple(flags),
        )


def write_site(
    store: Store, out: str | Path, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Write the board's pages into a folder: each file whole or absent, nothing taken away.

    The same board gives the same bytes; a file that holds them already is left alone.

    Args:
      store: an open store; read only.
      out: the folder; made where it is missing.
      progress: called with the number of files written and of all files.

    Returns:
      The path of `index.html`.

    Raises:
      NotPublishable: the reference rows are missing or leave 0 and 1; nothing is written.
      OptionError: the folder is a board, or one of those that a board consists of.
      BoardError: a file cannot be written.
    """
    out = Path(out)
    _refuse_board(out)
    pages = Pages(store)
    paths = list(pages.paths())

    def write(path: str, content: bytes) -> None:
        target = out / path
        if not (target.is_file() and target.read_bytes() == content):
            write_file(target, content)

    # Pages are made by this thread, which holds the store; the others wait for the disk.
    with ThreadPoolExecutor(_WRITERS) as pool:
        pending: deque[Any] = deque()
        for done, path in enumerate(paths, start=1):
            content = pages.read(path)
            assert content is not None, path
            if path == "index.html":
                _settle(pending, 0)  # whoever opens it finds everything that it leads to
            pending.append(pool.submit(write, path, content))
            _settle(pending, 4 * _WRITERS)
            if progress is not None:
                progress(done, len(paths))
        _settle(pending, 0)
    return out / "index.html"


def _refuse_board(out: Path) -> None:
    """Refuse a folder where pages would replace a board's files: a site has a board.json, too."""
    target = out.resolve()
    for above in (target, *target.parents):
        board = Folder(above)
        if not (board.key.exists() or (board.board.is_file() and board.log.is_dir())):
            continue
        own = (board.log, board.objects, board.results, board.submissions, board.withdrawals)
        if target == above or any(target.is_relative_to(folder.resolve()) for folder in own):
            raise OptionError(
                f"out={str(out)!r}: is of the board {above}, whose files the pages would replace. "
                f"Give another folder, such as {above / 'site'}."
            )


def content_type(path: str) -> str:
    """The media type of one of the site's files."""
    return _TYPES[Path(path).suffix]


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        auto_reload=False,
    )
    environment.filters["number"] = charts.number
    environment.filters["short"] = lambda digest: hex_of(digest)[:12]
    return environment


@cache
def _static() -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(STATIC.iterdir())}


def _log_page(number: int) -> str:
    return f"log-{number}.html"


def _https(link: str | None) -> str | None:
    """A link that may be followed: no other scheme reaches an attribute."""
    return link if link is not None and link.startswith("https://") else None


def _rank(first: int | None, last: int | None) -> str:
    if first is None:
        return ""
    return str(first) if last in (None, first) else f"{first}–{last}"


def steps_text(steps: int) -> str:
    """Environment steps as people say them: `500 k`, `1.2 M`."""
    for size, unit in ((10**9, "G"), (10**6, "M"), (10**3, "k")):
        if steps >= size:
            return f"{float(f'{steps / size:.3g}'):g} {unit}"
    return str(steps)


def _settle(pending: deque[Any], left: int) -> None:
    """Wait until at most `left` writes are under way; an error of theirs is raised here."""
    while len(pending) > left:
        pending.popleft().result()
