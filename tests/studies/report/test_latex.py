"""LaTeX tables fit the column of a two-column article, with any number and length of names."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest

from sme_registry.studies.report.latex import COLUMN_WIDTH, latex_table, text_width

NAMES = [
    "PPO", "SAC", "learning rate 0.0001 with a name that goes on",
    "ProximalPolicyOptimizationWithClippingAndManyOtherThings", "TD3 (symmetric)", "TD3 (unit)",
    "B.9+c-(d)", "constant ½",
]  # fmt: skip
CLASSES = ["default", "a-very-long-class-name-with_under_scores-and-k-25-r_min-0_5", "all classes"]
ENTRY = "+0.123 [−0.456, +0.789] (n = 3)"


def table(algorithms: int, classes: int = 3) -> str:
    frame = pd.DataFrame({"class": [CLASSES[i % 3] for i in range(classes)]})
    for name in NAMES[:algorithms]:
        frame[name] = ENTRY
    caption = "Difference of WD regret. IQM over pairs, 95 % interval. *: worse, †: better."
    return latex_table(frame, names=1, caption=caption, label=f"t{algorithms}-{classes}")


def test_columns_are_across_where_they_fit_and_long_tables_continue() -> None:
    assert "\\multicolumn{2}" not in table(1)
    assert all("\\multicolumn{2}" in table(n) for n in (2, 8))
    assert text_width(ENTRY) < COLUMN_WIDTH
    narrow = pd.DataFrame({"class": ["default"], "PPO": ["0.12"], "SAC": ["0.13"]})
    assert "PPO & SAC" in latex_table(narrow, names=1, caption="A", label="b")
    text = table(8, 12)
    assert text.count("\\begin{table}") == text.count("\\toprule") > 1
    assert "(continued)" in text
    assert "\\label{tab:t8-12-2}" in text


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
def test_pdflatex_finds_no_overfull_box(tmp_path: Path) -> None:
    tables = "\n".join(table(n, 6) + "\\clearpage" for n in (1, 2, 3, 8))
    packages = "\\usepackage{booktabs,tabularx,array}"
    document = f"\\documentclass[twocolumn]{{article}}{packages}\\begin{{document}}\n{tables}"
    (tmp_path / "paper.tex").write_text(document + "\n\\end{document}\n", encoding="ascii")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    log = (tmp_path / "paper.log").read_text(encoding="latin-1")
    assert done.returncode == 0, log
    assert "Overfull" not in log
    assert "too large" not in log
