"""`Pages`: the files of a board's site, each a function of the store.

    index.html, ood_regret.html, ood_decay.html    the board by each metric
    submissions/<64 hex>.html, .json    every submission; results/<64 hex>.json
    compare.html, board-data.js         comparison of chosen entries, drawn by static/board.js
    log.html, log-<n>.html              the log, `LOG_ROWS` entries a page, and how to verify it
    method.html, suite.html             the formulas; the tasks
    explorers/<64 hex>-<n>.html         on request, the explorer of run n of a scored submission
    suite.json, definition.json         the suite, to train on it, and the board's definition
    board.json, .csv, .tex              the board by N₀ as data; so are ood_regret.*, ood_decay.*

The pages are accessible HTML without inline script or style. Jinja2 escapes all text from
submitters. Only the drawings are marked as safe; they contain numbers and text that they escape
themselves.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment

from leaderboard.documents.board import hex_of
from leaderboard.documents.result import METRICS, RANKED, EntryRow, Estimate, Metric
from leaderboard.errors import CODES, NotPublishable
from leaderboard.gate import networks
from leaderboard.scoring import ranking
from leaderboard.store import Store
from leaderboard.web import tables
from leaderboard.web.tables import SHORT
from sme_registry import SMESpec
from sme_registry.explorer import STATIC
from sme_registry.io import to_json
from sme_registry.io.markup import environment

_HERE = Path(__file__).parent
LOG_ROWS = 200  # entries on a page of the log; a full page never changes again

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".csv": "text/csv; charset=utf-8",
    ".tex": "text/plain; charset=utf-8",
    ".svg": "image/svg+xml",
}
_NEED_SCORES = (*(tab.page for tab in RANKED.values()), "compare.html")


class Section(NamedTuple):
    """Further pages of a site: those of a track."""

    link: tuple[str, str]
    folder: Path
    files: Callable[[Pages], dict[str, Callable[[], str]]]


class Pages:
    """The pages of a board in its present state. Create another when its log has grown.

    `address` is where the board accepts submissions; None for a copy that accepts none.
    """

    def __init__(
        self,
        store: Store,
        address: str | None = None,
        *,
        explorers: bool = False,
        sections: Sequence[Section] = (),
    ) -> None:
        self.store = store
        self._sections = sections
        self._explorers = explorers
        self._address = address
        self.document = store.document

    @cached_property
    def entries(self) -> list[EntryRow]:
        """Every entry; `NotPublishable` if the reference rows are missing or off."""
        ranking.refuse_unpublishable(self._listed)
        return self._listed

    @cached_property
    def preparing(self) -> bool:
        """Whether the board is served, and its reference rows wait: no scores yet, but no fault."""
        try:
            self.entries  # noqa: B018  raises if the board may not publish
        except NotPublishable as error:
            return error.waiting and self._address is not None
        return False

    def read(self, path: str) -> bytes | None:
        """A file of the site by its path, such as `ood_regret.html`; None if there is none."""
        folder, _, name = path.rpartition("/")
        if folder == "static":
            return self._static.get(name)
        if path in self._definitions:  # without scores, and needed to train for the board
            return to_json(self._definitions[path]).encode()
        if self.preparing and path in _NEED_SCORES:
            return self.preparation().encode()
        if not (self.preparing and (path.endswith(".html") or folder == "submissions")):
            self.entries  # noqa: B018  raises if the board may not publish
        if folder in ("submissions", "results"):
            return self._document(folder, name)
        if folder == "explorers":
            return self._explorer(name)
        render = self._top.get(path)
        return render().encode() if render is not None else None

    def paths(self) -> Iterator[str]:
        """The paths of all files of the site; `index.html` last, so that its links work."""
        yield from (f"static/{name}" for name in self._static)
        yield from self._definitions
        for entry in self.entries:
            digits = hex_of(entry.id)
            yield f"submissions/{digits}.json"
            if entry.scores is not None or entry.code:
                yield f"results/{digits}.json"
            yield from (f"explorers/{digits}-{n}.html" for n in self._explored(entry.id))
            yield f"submissions/{digits}.html"
        yield from self._top

    @cached_property
    def _definitions(self) -> dict[str, Any]:
        files = {"suite.json": self.document.suite_file, "definition.json": self.document}
        return {path: document.to_dict() for path, document in files.items()}

    @cached_property
    def _top(self) -> dict[str, Callable[[], str]]:
        """The other files by path: functions that render them."""
        logs = range(self.store.head[0] // LOG_ROWS + 1)
        return {
            **{_log_page(number): partial(self._log, number) for number in logs},
            "board-data.js": self._data_js,
            "log.html": partial(self._log, logs[-1]),
            "method.html": self._method,
            "suite.html": self._suite,
            "compare.html": self._compare,
            **{path: render for part in self._files for path, render in part.items()},
            **{
                f"{tab.stem}.{kind}": partial(self._file, name, kind)
                for name, tab in RANKED.items()
                for kind in ("json", "csv", "tex")
            },
            **{tab.page: partial(self._board, name) for name, tab in reversed(RANKED.items())},
        }

    def _board(self, metric: Metric) -> str:
        tab = RANKED[metric]
        ranked = ranking.ranking(self.entries, metric)
        scores = [row.entry.scores for row in ranked if row.entry.scores]
        regrets = [[each.value for each in one.normalised_regret] for one in scores]
        sparks = tables.sparklines(regrets)
        submitted = [row for row in ranked if not row.entry.reference]
        return self.render(
            "board.html",
            here="index.html",
            title=tab.label,
            metric=tab,
            references=[row for row in ranked if row.entry.reference],
            ranked=[row for row in submitted if row.ranks],
            listed=[row for row in submitted if not row.ranks],
            families=sorted({row.entry.family for row in submitted}),
            knowledges=sorted({row.entry.knowledge for row in submitted}),
            unranked=[name for name in ranking.REASONS if name in {r.reason for r in submitted}],
            reasons=ranking.REASONS,
            names={id: f"{entry.method} {entry.version}" for id, entry in self._by_id.items()},
            **self._overview,
            bars=tables.Bars([row.shown(metric) for row in ranked], tab.references),
            sparks=dict(zip((row.entry.id for row in ranked), sparks, strict=True)),
        )

    def preparation(self, root: str = "") -> str:
        """The page of a board whose reference rows wait, which reloads itself."""
        here = "" if root else "index.html"
        overview = self._overview
        return self.render("preparing.html", here=here, root=root, title="Preparing", **overview)

    @cached_property
    def _overview(self) -> dict[str, Any]:
        """What a board shows besides its scores: the suite, what waits, and how to submit."""
        classes = self.document.suite.classes
        entrants = [entry for entry in self._listed if not entry.reference]
        return {
            "head": self.store.head,
            "instances": sum(len(member.seeds) for member in classes),
            "entrants": len(entrants),
            "waiting": [entry for entry in entrants if entry.status == "waiting"],
            "closed": [e for e in reversed(entrants) if e.status in ("rejected", "withdrawn")],
            "address": self._address,
            "seeds": max(
                len(one.seeds) * self.document.runs_on_each(len(one.seeds)) for one in classes
            ),
        }

    def _submission(self, id: str) -> str:
        """The page of a submission: waiting, scored, rejected or withdrawn."""
        entry = self._by_id[id]
        signed, result = self.store.submission(id), self.store.result(id)
        withheld = self.preparing and result is not None and result.scores is not None
        result = None if withheld else result
        withdrawal = self.store.withdrawal(id)
        submission = signed.content
        edges = self.document.protocol.edges
        chart, classes = "", []
        if result is not None and result.scores is not None:
            name = submission.method.name
            chart = tables.regret_chart(result.scores.normalised_regret, edges, name)
            sparks = tables.sparklines([each.normalised_regret for each in result.classes])
            classes = list(zip(result.classes, sparks, strict=True))
        scores = result.runs if result is not None and result.runs else itertools.repeat(None)
        versions = tables.versions_of(entry, self._listed)
        return self.render(
            "submission.html",
            here="",
            root="../",
            title=f"{submission.method.name} {submission.method.version}",
            id=id,
            hex=hex_of(id),
            s=submission,
            result=result,
            withheld=withheld,
            preparing=self.preparing,
            reason=self._reasons.get(id, ""),
            copies=[(each, self._by_id[each.id]) for each in entry.copy_of],
            versions=[(other, self._reasons.get(other.id, "")) for other in versions],
            entry=entry,
            withdrawal=withdrawal and withdrawal.content,
            codes=CODES,
            chart=chart,
            classes=classes,
            agents=[] if result is None else tables.agent_rows(self.document, submission, result),
            regions=tables.region_labels(edges),
            runs=zip(submission.runs, scores, strict=False),
            class_of=self._class_of,
            explored=self._explored(id),
        )

    def _compare(self) -> str:
        """The page on which `board.js` compares chosen entries."""
        estimates = [each for entry in self._scored for each in entry.scores.normalised_regret]
        chart = tables.comparison_chart(estimates, self.document.protocol.edges)
        return self.render(
            "compare.html", here="compare.html", title="Compare entries", chart=chart
        )

    def _log(self, page: int) -> str:
        """A page of the log, 0 for the oldest entries, with instructions to verify it."""
        last = self.store.head[0]
        return self.render(
            "log.html",
            here="log.html",
            title="Log and verification",
            address=self._address,
            head=self.store.head,
            entries=list(self.store.log(page * LOG_ROWS, LOG_ROWS)),
            page=page,
            pages=[
                (n, _log_page(n), n * LOG_ROWS, min((n + 1) * LOG_ROWS - 1, last))
                for n in range(last // LOG_ROWS + 1)
            ],
        )

    def _method(self) -> str:
        regions = tables.region_labels(self.document.protocol.edges)
        return self.render("method.html", here="method.html", title="Method", regions=regions)

    def _suite(self) -> str:
        classes, seeds = tables.task_rows(self.document), self._overview["seeds"]
        return self.render(
            "suite.html", here="suite.html", title="Suite", classes=classes, seeds=seeds
        )

    def _data_js(self) -> str:
        """`board-data.js`: the data of the comparison. A script, since `file:` forbids `fetch`."""

        def rounded(estimate: Estimate) -> list[float | None]:
            ends = estimate.interval or (None, None)
            return [x if x is None else round(x, 5) + 0.0 for x in (estimate.value, *ends)]

        data = {
            "regions": tables.region_labels(self.document.protocol.edges),
            "metrics": [text.label[0].upper() + text.label[1:] for text in METRICS.values()],
            "entries": [
                {
                    "id": hex_of(entry.id),
                    "name": f"{entry.method} {entry.version}",
                    "by": entry.submitter,
                    "scores": [rounded(getattr(entry.scores, key)) for key in METRICS],
                    "normalised_regret": [rounded(N) for N in entry.scores.normalised_regret],
                }
                for entry in self._scored
            ],
        }
        return f"window.boardData = {json.dumps(data, separators=(',', ':'))};\n"

    def _file(self, metric: Metric, kind: str) -> str:
        """The ranking by a metric as JSON, CSV or LaTeX."""
        # The date is the log's, not the clock's, so that the same board gives equal bytes.
        [last] = self.store.log(self.store.head[0], 1)
        rows = ranking.ranking(self.entries, metric)
        head = self.store.head[:2]
        file = tables.RankingFile(rows, metric, self.document, head, last.time)
        if kind == "json":
            return to_json(file.to_dict())
        return file.to_csv() if kind == "csv" else file.to_latex()

    def _document(self, folder: str, name: str) -> bytes | None:
        """The page of a submission, or its document or result."""
        digits, _, kind = name.partition(".")
        id = f"sha256:{digits}"
        if id not in self._by_id:
            return None
        if kind == "html" and folder == "submissions":
            return self._submission(id).encode()
        if kind != "json":
            return None
        document = self.store.submission(id) if folder == "submissions" else self.store.result(id)
        return None if document is None else to_json(document.to_dict()).encode()

    def _explored(self, id: str) -> list[int]:
        """The runs of a submission that have an explorer."""
        if not self._explorers or self._by_id[id].status != "scored":
            return []
        runs = enumerate(self.store.submission(id).content.runs)
        return [n for n, run in runs if run.artefact is not None and run.spec in self._shown]

    def _explorer(self, name: str) -> bytes | None:
        """The explorer of a run, by its file's name."""
        digits, _, number = name.removesuffix(".html").rpartition("-")
        id = f"sha256:{digits}"
        if id not in self._by_id or number not in map(str, self._explored(id)):
            return None
        submission = self.store.submission(id).content
        run, method = submission.runs[int(number)], submission.method
        assert run.artefact is not None  # it is explored
        data = self.store.objects.read(run.artefact.sha256)
        title = f"{method.name} {method.version}"
        return networks.explorer(title, data, self._shown[run.spec]).encode()

    @cached_property
    def _shown(self) -> dict[str, SMESpec]:
        """The instances that an explorer can show, by digest."""
        return {
            digest: spec.named(f"{name}, instance {digest[7:19]}")
            for digest, (name, spec) in self.document.instances.items()
            if networks.can_show(spec)
        }

    @cached_property
    def _static(self) -> dict[str, bytes]:
        """The files in static/, by name."""
        paths = [path for folder in self._folders for path in (folder / "static").iterdir()]
        of_explorers = STATIC if self._explorers else {}
        return {
            **{path.name: path.read_bytes() for path in sorted(paths)},
            **{name: text.encode() for name, text in of_explorers.items()},
        }

    @cached_property
    def _files(self) -> list[dict[str, Callable[[], str]]]:
        """The files of each section."""
        return [section.files(self) for section in self._sections]

    @cached_property
    def _by_id(self) -> dict[str, EntryRow]:
        return {entry.id: entry for entry in self._listed}

    @cached_property
    def _listed(self) -> list[EntryRow]:
        """Every entry, also of a board that may not publish its scores."""
        return self.store.entries()

    @cached_property
    def _reasons(self) -> dict[str, str]:
        """Why entries have no rank by any metric, by their ids; empty without scores to show."""
        if self.preparing:
            return {}
        return {row.entry.id: row.reason for row in ranking.ranking(self.entries, "wd_regret")}

    @cached_property
    def _scored(self) -> list[Any]:
        """Entries with scores that are not withdrawn."""
        return [entry for entry in self.entries if entry.scores and entry.status == "scored"]

    @cached_property
    def _class_of(self) -> dict[str, str]:
        return {digest: name for digest, (name, _) in self.document.instances.items()}

    @cached_property
    def _common(self) -> dict[str, Any]:
        """What every page needs. Documents compute their digests on each access."""
        document = self.document
        return {
            "root": "",
            "document": document,
            "digests": {
                "board": document.digest,
                "suite": document.suite.digest,
                "protocol": document.protocol.digest,
            },
            "learned": ranking.LEARNED,
            "links": tuple(
                section.link
                for section, files in zip(self._sections, self._files, strict=True)
                if section.link[0] in files
            ),
            "address_digits": SHORT,
            "metrics": list(RANKED.values()),
            "places": self.store.queue.places(),
        }

    def render(self, template: str, **values: Any) -> str:
        """A page from a template, with what every page needs."""
        templates = _environment(*self._folders)
        return templates.get_template(template).render({**self._common, **values})

    @property
    def _folders(self) -> list[Path]:
        return [_HERE, *(section.folder for section in self._sections)]


def content_type(path: str) -> str:
    return _TYPES[Path(path).suffix]


@cache
def _environment(*folders: Path) -> Environment:
    templates = environment(*(folder / "templates" for folder in folders), autoescape=True)
    templates.filters |= {
        "day": tables.day,
        "hex": hex_of,
        "https_only": tables.https_only,
        "minute": tables.minute,
        "number": tables.number,
        "short": tables.short,
        "steps": tables.steps_text,
    }
    return templates


def _log_page(number: int) -> str:
    return f"log-{number}.html"
