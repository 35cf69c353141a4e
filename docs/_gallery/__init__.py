"""The gallery: a card for each environment and stream of the catalogue."""

from .page import anchor, gallery
from .pictures import draw

__all__ = ["anchor", "draw", "gallery"]
