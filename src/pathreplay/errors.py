"""The exception for errors that users can fix, and the formatting of its one-line message."""

from __future__ import annotations

from numbers import Integral

# Maximum length of a message, in characters. A longer message is shortened in the middle, because its two ends name the
# object and the remedy.
_LONGEST = 1000


class PathreplayError(Exception):
    """An error that the user can fix.

    The message is a single line (`plain_line`) that names the object, its value and the remedy. The command line prints
    the message without a traceback and ends with exit status 2.
    """

    def __init__(self, message: str) -> None:
        super().__init__(plain_line(message))


def plain_line(text: str) -> str:
    """Convert text to one line: escape unprintable characters, and shorten a long text in the middle."""
    line = " ".join(text.split())
    line = "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in line)
    return _cut(line, _LONGEST)


def require_count(name: str, value: object, least: int) -> None:
    """Raise PathreplayError unless ``value`` is an integer from ``least`` on."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise PathreplayError(f"{name} is {shown(value)}; give an integer of at least {least}")


def shown(value: object, longest: int = 80) -> str:
    """Format a value given by the user for a message, shortened to at most ``longest`` characters."""
    try:
        return _cut(repr(value), longest)
    except ValueError:  # Python does not convert integers of more than 4300 digits to text
        return "a number of more than 4300 digits"
    except RecursionError:
        return f"a {type(value).__name__} nested too deep"


def _cut(text: str, longest: int) -> str:
    if len(text) <= longest:
        return text
    half = (longest - 5) // 2
    return f"{text[:half]} ... {text[-half:]}"
