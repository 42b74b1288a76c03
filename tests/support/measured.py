"""What tests measure, for the summary at the end of a session."""

from __future__ import annotations

from dataclasses import dataclass

#: Told at the end of the session: see conftest.py.
TOLD: list[str] = []


@dataclass(frozen=True)
class Difference:
    """How far two sets of pictures are from each other: normal deviates of the means and of the sums of squares."""

    mean: float  # the largest of the channels
    blocks: float
    pixels: float
    alpha: float  # the larger of mean and pixels
    relative: float  # (ours - theirs) / theirs, of the mean over all colours
    error: float  # standard error of ``relative``

    @property
    def z(self) -> float:
        return max(abs(self.mean), self.blocks, self.pixels, self.alpha)


PRIMALS: list[tuple[str, Difference]] = []


def table() -> str:
    """All pictures so far: pathreplay against volpath."""
    lines = [f"{'scene':40s} {'error':>6s} {'mean':>7s} {'blocks':>7s} {'pixels':>7s} {'alpha':>7s} {'relative':>9s}"]
    for name, d in PRIMALS:
        cells = f"{d.error:6.2%} {d.mean:+7.2f} {d.blocks:+7.2f} {d.pixels:+7.2f} {d.alpha:+7.2f} {d.relative:+9.2%}"
        lines.append(f"{name:40s} {cells}")
    return "\n".join(lines)


# Cells that are left out, and why; printed with the table.
EXCLUSIONS = {
    "roughplastic alpha": "Mitsuba's own transmittance tables carry no derivative (prb has +0.024 for -0.436)",
    "dielectric eta, plastic eta": "plain numbers in Mitsuba; dielectric_ad has a differentiable index",
    "blend with a delta child": "its primal image is biased: the density that it returns mixes Dirac deltas and others",
    "mask opacity at exactly 0 or 1": "the lobe that would appear is never drawn",
    "plastic, diffuse reflectance exactly 0": "the diffuse lobe is then never drawn, so only its direct light counts",
    "plastic specular reflectance, blend weight exactly 0": "likewise: the lobe or child is never drawn",
    "mask over delta lobes that compete (plastic, glass)": "Mitsuba cannot sample them one by one there; warned",
    "instance to_world": "Mitsuba does not differentiate the normals of instances; refused",
    "replay with a zero weight": "the seed algorithm divides by the weight; sweep and forward do not",
}
