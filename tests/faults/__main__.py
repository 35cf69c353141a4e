"""Plant random faults in the packages, one at a time, and ask the tests whether they notice.

    python -m tests.faults map                              # once: which tests run which line
    python -m tests.faults plant --seed 1 --count 80 --out tests/faults/x.jsonl [PATH ...]
    python -m tests.faults again tests/faults/x.jsonl --out tests/faults/y.jsonl
    python -m tests.faults show tests/faults/x.jsonl [tests/faults/y.jsonl]

A fault is drawn by its statement: every statement of the paths (both packages, if none is named) is
as likely as any other. It is planted in a copy of the tree, the tests that run its line are called
there, the cheapest first and at most `--seconds` of them; the first failure ends them. A verdict
is written as soon as it is known, and an interrupted call goes on where it stopped. `again` plants
the same faults, found by their text, under the tests of today.

Outside the suite: 80 faults take about half an hour on one core.
"""

from __future__ import annotations

import argparse
import ast
import itertools
import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parents[2]
PACKAGES = ("sme_registry", "leaderboard")
MAP = ROOT / "build" / "faults"

SWAPS: dict[type[ast.AST], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*",
    ast.Pow: "*", ast.And: "or", ast.Or: "and",
}  # fmt: skip
CALLS = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum",
         "maximum": "minimum", "ceil": "floor", "floor": "ceil", "zeros": "ones"}  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """The text `before` at a place of a file, replaced by `after`; `statement` is its line."""

    path: str
    line: int
    column: int
    before: str
    after: str
    statement: str
    verdict: str = ""
    by: str = ""
    seconds: float = 0.0

    def __str__(self) -> str:
        return f"{self.path}:{self.line}  {self.before[:60]!r} -> {self.after[:60]!r}"

    @property
    def key(self) -> tuple[str, int, int, str, str]:
        return self.path, self.line, self.column, self.before, self.after


class Source:
    """A file whose statements can be changed."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.text = (ROOT / path).read_text(encoding="utf-8")
        self.lines = self.text.splitlines(keepends=True)
        self._starts = [0, *itertools.accumulate(map(len, self.lines))]
        self.tree = ast.parse(self.text)

    def offset(self, line: int, column: int) -> int:
        return self._starts[line - 1] + len(self.lines[line - 1].encode()[:column].decode())

    def segment(self, node: ast.AST) -> str:
        start = self.offset(node.lineno, node.col_offset)  # type: ignore[attr-defined]
        return self.text[start : self.offset(node.end_lineno, node.end_col_offset)]  # type: ignore[attr-defined]

    def statements(self) -> list[ast.stmt]:
        """All but docstrings, imports, definitions' own lines and what only type checkers read."""
        skipped = (
            *(ast.Import, ast.ImportFrom, ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef),
            *(ast.Pass, ast.Try),
        )
        return [
            node
            for node in ast.walk(self.tree)
            if isinstance(node, ast.stmt)
            and not isinstance(node, skipped)
            and not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
            and not (isinstance(node, ast.If) and "TYPE_CHECKING" in self.segment(node.test))
            and not self.segment(node).startswith("__all__")
        ]

    def faults(self, statement: ast.stmt) -> list[Fault]:
        """Every fault of a statement, those of the statements inside it apart."""
        found = list(self._dropped(statement))
        for node in own_expressions(statement):
            found += self._in_expression(node)
        if isinstance(statement, ast.If | ast.While):
            test = self.segment(statement.test)
            found.append(self._fault(statement.test, test, f"(not ({test}))"))
        return [replace(fault, statement=self.lines[fault.line - 1].strip()) for fault in found]

    def _fault(self, node: ast.expr | ast.stmt, before: str, after: str) -> Fault:
        return Fault(self.path, node.lineno, node.col_offset, before, after, "")

    def _dropped(self, statement: ast.stmt) -> Iterator[Fault]:
        text = self.segment(statement)
        effect = (
            (isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call | ast.Await))
            or isinstance(statement, ast.Raise | ast.AugAssign | ast.Continue | ast.Break)
            or (isinstance(statement, ast.Assign)
                and isinstance(statement.targets[0], ast.Attribute | ast.Subscript))
        )  # fmt: skip
        if effect:
            yield self._fault(statement, text, "pass")
        if isinstance(statement, ast.Return) and statement.value is not None:
            value = self.segment(statement.value)
            if value not in ("None", "NotImplemented"):
                yield self._fault(statement, text, "return None")

    def _in_expression(self, node: ast.AST) -> Iterator[Fault]:
        text = self.segment(node)
        match node:
            case ast.Compare(ops=[operator], left=left, comparators=[right]):
                yield self._between(node, left, operator, right)
            case ast.BinOp(op=operator, left=left, right=right) if type(operator) in SWAPS:
                if not (_is_text(left) or _is_text(right)):
                    yield self._between(node, left, operator, right)
            case ast.BoolOp(op=operator, values=[left, right, *_]):
                yield self._between(node, left, operator, right)
            case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
                yield self._fault(node, text, f"({self.segment(operand)})")
            case ast.Constant(value=bool() as value):
                yield self._fault(node, text, str(not value))
            case ast.Constant(value=int() as value):
                yield self._fault(node, text, str(value + 1))
            case ast.Constant(value=float() as value):
                yield self._fault(node, text, repr(value * 2 if value else 1.0))
            case ast.IfExp(test=test):
                condition = self.segment(test)
                yield self._fault(test, condition, f"(not ({condition}))")
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in CALLS:
                function = self.segment(node.func)
                yield self._fault(node.func, function, function.removesuffix(name) + CALLS[name])

    def _between(self, node: ast.AST, left: ast.AST, op: ast.AST, right: ast.AST) -> Fault:
        whole, first, second = self.segment(node), self.segment(left), self.segment(right)
        return self._fault(node, whole, f"(({first}) {SWAPS[type(op)]} ({second}))")

    def planted(self, fault: Fault) -> str:
        at = self.offset(fault.line, fault.column)
        assert self.text.startswith(fault.before, at), f"{fault} is not there"
        return self.text[:at] + fault.after + self.text[at + len(fault.before) :]

    def moved(self, fault: Fault) -> Fault | None:
        """The fault where its text stands now: the nearest same statement, None if it is gone."""
        places = [
            (abs(number - fault.line), number, line.index(fault.statement))
            for number, line in enumerate(self.lines, 1)
            if line.strip() == fault.statement
        ]
        for _, number, _ in sorted(places):
            shift = number - fault.line
            there = replace(fault, line=fault.line + shift)
            if self.text.startswith(fault.before, self.offset(there.line, there.column)):
                return there
        return None


def _is_text(node: ast.AST) -> bool:
    """Whether a node is a string: another operator on one, or on a path, fails at once."""
    literal = isinstance(node, ast.Constant) and isinstance(node.value, str)
    return literal or isinstance(node, ast.JoinedStr)


def own_expressions(statement: ast.stmt) -> Iterator[ast.expr]:
    """The expressions of a statement that are of no statement inside it, annotations apart."""
    waiting: list[ast.AST] = [
        child
        for name, value in ast.iter_fields(statement)
        if name not in ("body", "orelse", "finalbody", "handlers", "cases", "annotation")
        for child in (value if isinstance(value, list) else [value])
        if isinstance(child, ast.AST)
    ]
    while waiting:
        node = waiting.pop()
        if not isinstance(node, ast.JoinedStr):  # the segments in f-strings are not where they say
            if isinstance(node, ast.expr):
                yield node
            waiting += ast.iter_child_nodes(node)


def draw(paths: list[str], seed: int, count: int) -> list[Fault]:
    """Distinct faults, at most one for a statement, each of a statement drawn uniformly."""
    files = sorted(
        str(path.relative_to(ROOT))
        for name in paths
        for path in ([ROOT / name] if name.endswith(".py") else (ROOT / name).rglob("*.py"))
    )
    places = []
    for name in files:
        source = Source(name)
        places += [(source, statement) for statement in source.statements()]
    rng = random.Random(seed)
    rng.shuffle(places)
    drawn: list[Fault] = []
    for source, statement in places:
        if len(drawn) == count:
            break
        if faults := source.faults(statement):
            drawn.append(rng.choice(faults))
    return drawn


# ------------------------------------------------------------------- which tests run which line


def make_map(arguments: argparse.Namespace) -> None:
    """Run the suite once under coverage; keeps its lines by test, and each test's seconds."""
    MAP.mkdir(parents=True, exist_ok=True)
    config = MAP / "coveragerc"
    config.write_text(f"[run]\nsource = {','.join(PACKAGES)}\ndata_file = {MAP / 'lines'}\n")
    command = [
        sys.executable, "-m", "pytest", "-q", "-n", str(arguments.workers), "--cov",
        "--dist=loadfile", "--no-loadscope-reorder",
        "-k", "not read_only_folder_is_a_typed",  # as nobody, it may not write to the map
        f"--cov-config={config}", "--cov-context=test", "--cov-report=",
        f"--junitxml={MAP / 'seconds.xml'}",
    ]  # fmt: skip
    subprocess.run(command, cwd=ROOT, env={**os.environ, "COVERAGE_CORE": "ctrace"})


class Cover:
    """The tests of each line, and how long each took."""

    def __init__(self, folder: Path) -> None:
        self._data = sqlite3.connect(folder / "lines")
        self._files = {
            self._relative(path): number
            for number, path in self._data.execute("select id, path from file")
        }
        contexts = self._data.execute("select context from context where context != ''")
        self.names = {context.rpartition("|")[0] for (context,) in contexts}
        self._seconds: dict[tuple[str, str], float] = defaultdict(float)
        for case in ElementTree.parse(folder / "seconds.xml").iter("testcase"):
            key = case.get("classname", ""), case.get("name", "")
            self._seconds[key] += float(case.get("time", 0))

    @staticmethod
    def _relative(path: str) -> str:
        parts = Path(path).parts
        first = next(i for i, part in enumerate(parts) if part in PACKAGES)
        return "/".join(parts[first:])

    def seconds(self, name: str) -> float:
        """How long a test took, named as pytest names it: the report has dots and no ending."""
        where, parameters = name.partition("[")[::2]
        *parts, last = where.split("::")
        test = f"{last}[{parameters}" if parameters else last
        return self._seconds[".".join(parts).replace(".py", "").replace("/", "."), test]

    def tests(self, path: str, first: int, last: int) -> set[str]:
        """Those that ran a line of a range, or the file at all where the range runs at import."""
        from coverage.numbits import numbits_to_nums

        inside, anywhere = set(), set()
        query = (
            "select context.context, line_bits.numbits from line_bits join context"
            " on context.id = line_bits.context_id where file_id = ?"
        )
        for context, bits in self._data.execute(query, [self._files.get(path, -1)]):
            test = context.rpartition("|")[0]
            if test:
                anywhere.add(test)
                if any(first <= number <= last for number in numbits_to_nums(bits)):
                    inside.add(test)
        return inside or anywhere or self._area(path)

    def _area(self, path: str) -> set[str]:
        """The tests in the innermost folder that mirrors the file's: for child processes."""
        folder = Path(path).parent
        if folder.parts[0] == "sme_registry":
            folder = Path(*folder.parts[1:])
        while True:
            here = {name for name in self.names if name.startswith(f"tests/{folder}/")}
            if here or folder == folder.parent:
                return here
            folder = folder.parent

    def chosen(self, fault: Fault, seconds: float) -> list[str]:
        """The tests to call, the cheapest first, as many as fit in the seconds; at least one."""
        rows = fault.before.count("\n")
        tests = self.tests(fault.path, fault.line, fault.line + rows)
        stem = Path(fault.path).stem

        def order(name: str) -> tuple[bool, bool, float, str]:
            return self.seconds(name) > 1, stem not in name, self.seconds(name), name

        chosen, total = [], 0.0
        for name in sorted(tests, key=order):
            total += self.seconds(name) + 0.01
            if chosen and total > seconds:
                break
            chosen.append(name)
        return chosen


# ------------------------------------------------------------------------------- plant and judge


def copied(folder: Path) -> None:
    """The tracked files of the working tree."""
    command = ["git", "ls-files", "-co", "--exclude-standard", "-z"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    names = done.stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def call(tree: Path, tests: list[str], limit: float) -> tuple[str, str]:
    """Run tests in a copy: the verdict, and the test that failed."""
    listing = tree / "build" / "tests.txt"
    listing.parent.mkdir(exist_ok=True)
    listing.write_text("\n".join(tests))
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", f"@{listing}"]
    process = subprocess.Popen(
        command, cwd=tree, env={**os.environ, "PYTHONPATH": str(tree)}, process_group=0,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        out, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "found", "a time-out"
    failed = [line for line in out.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    if process.returncode == 0:
        return "survived", ""
    if not failed and process.returncode not in (1, 2, 4):
        return "found", f"pytest ended with {process.returncode}"
    return "found", failed[0].split(" - ")[0][:200] if failed else out.strip()[-300:]


def judge(faults: list[Fault], arguments: argparse.Namespace) -> None:
    """Give each fault its verdict and append it to the file of verdicts."""
    cover = Cover(Path(arguments.map))
    out = Path(arguments.out)
    known = {fault.key for fault in read(out)} if out.exists() else set()
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        copied(tree)
        for number, fault in enumerate(faults, 1):
            if fault.key in known:
                continue
            start = time.monotonic()
            if fault.verdict == "gone":
                judged = fault
            else:
                source = Source(fault.path)
                (tree / fault.path).write_text(source.planted(fault), encoding="utf-8")
                tests = cover.chosen(fault, arguments.seconds)
                verdict, by = (
                    call(tree, tests, 60 + 4 * arguments.seconds) if tests else ("survived", "")
                )
                (tree / fault.path).write_text(source.text, encoding="utf-8")
                took = round(time.monotonic() - start, 1)
                judged = replace(
                    fault, verdict=verdict, by=by or f"{len(tests)} tests", seconds=took
                )
            with out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(judged), ensure_ascii=False) + "\n")
            print(f"{number:3}/{len(faults)} {judged.verdict:9} {judged.seconds:6} s  "
                  f"{judged}  {judged.by[:80]}", flush=True)  # fmt: skip
    print(summary(read(out)))


def read(path: Path) -> list[Fault]:
    return [Fault(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def summary(faults: list[Fault]) -> str:
    found = sum(fault.verdict == "found" for fault in faults)
    judged = sum(fault.verdict in ("found", "survived") for fault in faults)
    return f"{found} of {judged} found"


def again(arguments: argparse.Namespace) -> None:
    """Plant the faults of a file of verdicts anew."""
    faults = []
    for fault in read(Path(arguments.verdicts)):
        there = Source(fault.path).moved(fault) if (ROOT / fault.path).exists() else None
        faults.append(
            replace(there, verdict="", by="", seconds=0.0) if there
            else replace(fault, verdict="gone", by="", seconds=0.0)
        )  # fmt: skip
    judge(faults, arguments)


def show(arguments: argparse.Namespace) -> None:
    """Print the faults that survived, and which verdicts differ between files."""
    tables = [read(Path(name)) for name in arguments.verdicts]
    for name, faults in zip(arguments.verdicts, tables, strict=True):
        print(f"{name}: {summary(faults)}")
        for fault in faults:
            if fault.verdict != "found":
                print(f"  {fault.verdict} {fault}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(required=True)
    mapping = commands.add_parser(
        "map", help="run the suite once and keep which test runs which line"
    )
    mapping.add_argument("--workers", type=int, default=os.cpu_count())
    mapping.set_defaults(call=make_map)
    planting = commands.add_parser("plant", help="draw faults and judge them")
    planting.add_argument("paths", nargs="*", default=list(PACKAGES), metavar="PATH")
    planting.add_argument("--seed", type=int, default=0)
    planting.add_argument("--count", type=int, default=80)
    planting.set_defaults(call=lambda a: judge(draw(a.paths, a.seed, a.count), a))
    repeating = commands.add_parser("again", help="judge the faults of a file anew")
    repeating.add_argument("verdicts")
    repeating.set_defaults(call=again)
    for command in (planting, repeating):
        command.add_argument("--out", required=True)
        command.add_argument("--seconds", type=float, default=60, help="of tests for a fault")
        command.add_argument("--map", default=MAP, help="folder that `map` wrote")
    showing = commands.add_parser("show", help="what survived")
    showing.add_argument("verdicts", nargs="+")
    showing.set_defaults(call=show)
    arguments = parser.parse_args()
    for path in getattr(arguments, "paths", ()):
        if not (ROOT / path).exists():
            parser.error(f"{path}: does not exist. Name files or folders of the two packages.")
    if "map" in arguments and not (Path(arguments.map) / "lines").exists():
        parser.error(f"--map {arguments.map}: has no map. Run `python -m tests.faults map` first.")
    arguments.call(arguments)


if __name__ == "__main__":
    main()
