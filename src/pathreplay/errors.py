"""The one exception that users are meant to see: a mistake they can mend, told in one line."""

from __future__ import annotations


class PathreplayError(Exception):
    """A mistake that the user can mend.

    The message is a single line that names the thing, its value and the way out. The command line prints it
    without a traceback and ends with exit status 2.
    """
