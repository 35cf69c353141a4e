"""The board's pages: static, accessible HTML without inline script or style, and data files.

`write_site` writes them into a folder; a server reads them from `Pages`.
"""

from leaderboard.web.site.pages import STATIC, Pages, content_type
from leaderboard.web.site.write import write_site

__all__ = ["STATIC", "Pages", "content_type", "write_site"]
