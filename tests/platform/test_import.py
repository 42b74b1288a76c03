"""What a process loads before its first gradient: no library that most processes do not need."""

from __future__ import annotations

import subprocess
import sys

from variant import BACKEND

LATER = "scipy", "matplotlib", "pydantic", "rich", "jinja2", "trimesh"
CODE = f"""
import sys
import pathreplay, mitsuba as mi
mi.set_variant("{BACKEND}_ad_rgb")
mi.load_dict({{"type": "pathreplay"}})
print(*(name for name in {LATER} if name in sys.modules))
"""


def test_integrators_load_no_large_library() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert not done.stdout.split()
