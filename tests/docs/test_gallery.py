"""The gallery: a card for every entry of the catalogue, with its own numbers and picture."""

import io
import re

import numpy as np
import pytest
from PIL import Image

from sme_registry.spec import EnvFile, StreamFile, catalogue
from tests.docs.conftest import ROOT

pytest.importorskip("matplotlib")

from _gallery import measured, pictures

PAGES = sorted((ROOT / "docs" / "reference" / "generated").glob("catalogue-*.md"))
FOLDER = ROOT / "docs" / "reference" / "gallery"
CARDS = dict(
    card
    for page in PAGES
    for card in re.findall(r"^## (\S+)\n(.*?)(?=^## |\Z)", page.read_text("utf-8"), re.M | re.S)
)
ENTRIES = {file.name: file for kind in (EnvFile, StreamFile) for file in catalogue.entries(kind)}


def test_every_entry_of_the_catalogue_has_a_card_with_its_description_and_a_picture():
    assert CARDS.keys() == ENTRIES.keys()
    for name, file in ENTRIES.items():
        assert file.description in CARDS[name], name
        assert f"`SME/{file.versioned_name}`" in CARDS[name]
        (picture,) = re.findall(r"\]\(\.\./(gallery/\S+\.png)\)", CARDS[name])
        assert (ROOT / "docs" / "reference" / picture).is_file()


@pytest.mark.parametrize("name", ["ActionDim1", "Team2", "Safety10", "Cycle2"])
def test_the_numbers_of_a_card_are_those_that_are_measured_now(name):
    file = ENTRIES[name]
    document = file.spec if isinstance(file, EnvFile) else file.stream
    kept = measured.measured()[file.versioned_name]
    assert kept.pop("digest") == document.digest

    now, kept = flat(measured.measure(document)), flat(kept)
    assert now.keys() == kept.keys()
    for path, value in kept.items():
        same = value if isinstance(value, str) else pytest.approx(value, rel=1e-3)
        assert now[path] == same, path


def flat(value, path=""):
    """Every number and text in nested data, by its path."""
    if not isinstance(value, dict | list):
        return {path: value}
    pairs = value.items() if isinstance(value, dict) else enumerate(value)
    return {k: v for key, each in pairs for k, v in flat(each, f"{path}/{key}").items()}


@pytest.mark.parametrize("name", ["ActionDim1-v1", "Safety40-v1", "TeamBlind4-v1", "Related5-v1"])
def test_a_picture_drawn_again_is_the_same(name):
    content = pictures.picture(name)
    assert content == pictures.picture(name)
    new, kept = (
        np.asarray(Image.open(source))
        for source in (io.BytesIO(content), FOLDER / pictures.names()[name])
    )
    assert new.shape == kept.shape
    assert np.mean(new != kept) < 0.01  # another machine may round an edge differently


def test_pictures_of_equal_optima_are_shared_and_the_folder_has_no_others():
    names = pictures.names()
    assert names["Interval5-v1"] == names["Default-v1"] == "Default-v1.png"
    assert names["Safety40-v1"] != names["Safety20-v1"] != names["Default-v1"]
    assert {path.name for path in FOLDER.iterdir()} == set(names.values())
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 250_000


def test_a_pixel_of_a_picture_is_the_optimal_action_there():
    task = pictures.materialize(ENTRIES["Plane1"].spec)
    image = np.asarray(Image.open(FOLDER / "Plane1-v1.png"))[::-1]  # rows by s2
    side = (np.arange(160) + 0.5) / 80 - 0.5
    for row, column in ((20, 30), (81, 75), (140, 90)):
        a = task.policy(np.array([[side[column], side[row]]]))[0, 0]
        assert abs(image[row, column] - a * 16) <= 1.1
