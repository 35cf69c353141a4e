"""The figures of the pages: used, described, small, and what the data draw."""

import io
import re

import numpy as np
import pytest
from PIL import Image

from tests.docs.conftest import ROOT

pytest.importorskip("matplotlib")

import figures
from _figures import results

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
IMAGES = [
    (page, *found)
    for page in PAGES
    if "_build" not in page.parts
    for found in re.findall(r"!\[([^\]]*)\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
]


def test_every_image_of_a_page_exists_and_is_described():
    assert len(IMAGES) > 60
    for page, text, address in IMAGES:
        assert (page.parent / address).is_file(), (page, address)
        assert len(text) > 30, (page, address)


def test_every_figure_is_on_a_page_and_small():
    shown = {(page.parent / address).resolve() for page, _, address in IMAGES}
    drawn = {path.resolve() for path in figures.FOLDER.iterdir()}
    assert drawn == {figures.FOLDER / f"{name}.png" for name in figures.FIGURES}
    assert drawn <= shown
    assert max(path.stat().st_size for path in drawn) < 40_000


@pytest.mark.parametrize("name", figures.FIGURES)
def test_a_figure_drawn_again_is_the_one_of_the_page(name):
    new, kept = (
        np.asarray(Image.open(source).convert("L"), dtype=float)
        for source in (io.BytesIO(figures.picture(name)), figures.FOLDER / f"{name}.png")
    )
    assert new.shape == kept.shape
    assert np.mean(np.abs(new - kept) > 16) < 0.002, f"run `python docs/figures.py {name}`"


def test_the_figure_of_ranks_has_the_numbers_of_the_baselines():
    baselines = results.baselines()
    assert list(baselines) == ["TD3", "PPO", "SAC"]
    assert baselines["TD3"] == [(0.370, 0.260, 0.481), (0.463, 0.352, 0.574)]


def test_the_figure_of_an_overview_shows_the_similarity_of_three_runs_at_each_depth():
    figure = results.overview()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:2] == ["1 layer (n = 3)", "10 layers (n = 3)"]
    assert figure.axes[-1].get_ylabel() == "similarity to the optimum"
