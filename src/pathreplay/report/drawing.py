"""Matplotlib as reports use it: with the settings that it comes with, whatever the user's files and variables say."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from pathreplay.errors import PathreplayError

# Of a user's: a backend that is none, or a file that cannot be read, ends the import. Reports use no backend.
_SETTINGS = {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}


def _import() -> None:
    """Import matplotlib. Raises PathreplayError where a file of settings in the current folder cannot be read."""
    try:
        import matplotlib
    except (ValueError, RuntimeError):
        for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
            del sys.modules[name]  # half imported
        before = {name: os.environ.get(name) for name in _SETTINGS}
        os.environ.update(_SETTINGS)
        try:
            import matplotlib  # noqa: F401
        except (ValueError, RuntimeError) as error:
            raise PathreplayError(
                f"matplotlib cannot be imported ({error}); mend its settings (matplotlibrc)"
            ) from None
        finally:
            for name, value in before.items():
                os.environ.pop(name)
                if value is not None:
                    os.environ[name] = value


_import()

import matplotlib  # noqa: E402
from matplotlib.figure import Figure as Figure  # noqa: E402


@contextmanager
def own_settings() -> Iterator[None]:
    """Within this block figures are made and drawn by the settings that matplotlib comes with."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        yield
