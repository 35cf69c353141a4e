"""The board's pages: static, accessible HTML without inline script or style, and data files.

The same functions write a folder (`write_site`) and answer a server's requests (`Pages`).
"""

from leaderboard.web.site.render import STATIC, Pages, content_type, write_site

__all__ = ["STATIC", "Pages", "content_type", "write_site"]
