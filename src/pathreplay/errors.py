"""The one exception that users are meant to see: a mistake they can mend, told in one line."""

from __future__ import annotations

# Beyond, a message is no line that anyone reads; its two ends name the thing and the remedy.
_LONGEST = 1000


class PathreplayError(Exception):
    """A mistake that the user can mend.

    The message is a single line that names the thing, its value and the remedy (`plain_line`). The command line prints
    it without a traceback and ends with exit status 2.
    """

    def __init__(self, message: str) -> None:
        super().__init__(plain_line(message))


def plain_line(text: str) -> str:
    """``text`` as one line of printable characters: others are escaped, what is too long is cut in the middle."""
    line = " ".join(text.split())
    line = "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in line)
    return _cut(line, _LONGEST)


def shown(value: object, longest: int = 80) -> str:
    """A value that the user wrote, as it may stand in a message: never long, whatever it is."""
    try:
        return _cut(repr(value), longest)
    except ValueError:  # Python prints no whole number of more than 4300 digits
        return "a number of more than 4300 digits"
    except RecursionError:
        return f"a {type(value).__name__} nested too deep"


def _cut(text: str, longest: int) -> str:
    if len(text) <= longest:
        return text
    half = (longest - 5) // 2
    return f"{text[:half]} ... {text[-half:]}"
