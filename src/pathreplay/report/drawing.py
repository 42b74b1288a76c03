"""Imports Matplotlib with its default settings, regardless of the user's configuration files and variables."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from pathreplay.errors import PathreplayError

# With these settings, an invalid backend or an unreadable settings file of the user cannot make the import fail.
_SETTINGS = {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}


def _import() -> None:
    """Import matplotlib. Raises PathreplayError if a settings file in the current folder cannot be read."""
    try:
        import matplotlib
    except (ValueError, RuntimeError):
        for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
            del sys.modules[name]  # remove partially imported modules
        before = {name: os.environ.get(name) for name in _SETTINGS}
        os.environ.update(_SETTINGS)
        try:
            import matplotlib  # noqa: F401
        except (ValueError, RuntimeError) as error:
            raise PathreplayError(f"matplotlib cannot be imported ({error}); fix its settings (matplotlibrc)") from None
        finally:
            for name, value in before.items():
                os.environ.pop(name)
                if value is not None:
                    os.environ[name] = value


_import()

import matplotlib  # noqa: E402
from matplotlib.axes import Axes as Axes  # noqa: E402
from matplotlib.figure import Figure as Figure  # noqa: E402


@contextmanager
def own_settings() -> Iterator[None]:
    """Create and draw figures with matplotlib's default settings within this block."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        yield
