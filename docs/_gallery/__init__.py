"""The catalogue's pages: a card for each environment and stream."""

from .page import READING, anchor, gallery, group_of
from .pictures import draw

__all__ = ["READING", "anchor", "draw", "gallery", "group_of"]
