"""Studies that have been run: folders with real results of learners that learn in milliseconds."""

import dataclasses

from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.report.findings import findings
from sme_registry.studies.report.tables import analyse
from sme_registry.studies.result import CellFailure
from tests.studies.cells import file_of

LEARNERS = {
    "Alpha": {"half_life": 10.0, "r_min": 0.7, "k": 0.02},
    "Beta": {"half_life": 6.0, "k": 0.25, "complexity": 0.1},
}
CLASSES = {
    "default": {},
    "k-25": {"k": 25},
    "r_min-0_5": {"r_min": 0.5},
    "complexity-10": {"complexity": 10, "policy_init": "unit_variance"},
    "plane": {"state_dim": 2, "action_dim": 2, "complexity": 10},
}


def study_file(classes=CLASSES, learners=LEARNERS, **fields):
    """Learners and a reference on small classes, with five seeds each."""
    algorithms = [
        {"name": name, "uses": "tests.studies.learners:blend", "hyperparameters": own}
        for name, own in learners.items()
    ]
    small = {"state_dim": 8, "action_dim": 4, "horizon": 20}
    fields = {
        "classes": [
            {"name": name, "setting": small | setting, "seeds": [1, 2, 3, 4, 5]}
            for name, setting in classes.items()
        ],
        "algorithms": [
            *algorithms,
            {"name": "constant", "uses": "reference:constant", "steps": 0},
        ],
        "seeds": 5,
        "steps": 40,
        "evaluations": 20,
        "evaluation_episodes": 3,
        "protocol": {"states_per_region": 100, "epsilons": [0.5, 1.0]},
    } | fields
    return file_of("finished", **fields)


def finish(folder):
    """Run `study_file`; of Beta on k-25 two runs are missing, of which one failed."""
    file, ledger = study_file(), Ledger(folder)
    ledger.write_plan(file)
    for planned in file.plan.cells:
        cell = planned.cell
        if (planned.class_name, planned.algorithm) != ("k-25", "Beta") or planned.run < 3:
            ledger.write(run_cell(cell))
        elif planned.run == 3:
            error = {"error": "ValueError: <b>bad</b>", "traceback": "", "versions": {}}
            ledger.write(CellFailure(key=cell.digest, cell=cell, **error))


def analysed(folder, leave_out=lambda planned: False, draws=300):
    """The tables of a folder's runs, except for those left out."""
    ledger = Ledger(folder)
    file = ledger.study_file()
    gone = {planned.cell.digest for planned in file.plan.cells if leave_out(planned)}
    results = {key: result for key, result in ledger.results().items() if key not in gone}
    errors = {key: failure.error for key, failure in ledger.failures().items()}
    return analyse(file, results, errors, draws=draws)


def rows_of(table, **values):
    """The rows of a table that have these values."""
    for name, value in values.items():
        table = table[table[name] == value]
    return table


def found(analysis, **at):
    """The findings with these values, by question."""
    return {row.question: row for row in rows_of(findings(analysis), **at).itertuples()}


def with_tables(analysis, **tables):
    """The analysis with other tables."""
    return dataclasses.replace(analysis, tables=analysis.tables | tables)
