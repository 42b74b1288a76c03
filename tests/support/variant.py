"""The variant that tests run in: `llvm_ad_rgb`, or what PATHREPLAY_TEST_VARIANT names, on a machine with a GPU."""

import os

VARIANT = os.environ.get("PATHREPLAY_TEST_VARIANT", "llvm_ad_rgb")
