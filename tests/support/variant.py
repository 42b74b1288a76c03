"""The variant that tests run in: `llvm_ad_rgb`, or what PATHREPLAY_TEST_VARIANT names, on a machine with a GPU."""

import os

from pathreplay.platform.device import backend_of

VARIANT = os.environ.get("PATHREPLAY_TEST_VARIANT", "llvm_ad_rgb")
BACKEND = backend_of(VARIANT)
#: Variants with other colours on the same back end, for tests that start a process in them.
MONO, SPECTRAL = f"{BACKEND}_ad_mono", f"{BACKEND}_ad_spectral"
