"""The compared methods: integrators, and ways to use an integrator, by their names in the tables.

A method is the name of an integrator, optionally followed by a way of using it: `sweep`, or `prb, own loop`. This
module imports nothing, because `first.py` times imports.
"""

#: What `mi.load_dict` makes of it. One that does not load is a row that says so. Ours draw the numbers that Mitsuba's
#: draw, so that estimators are compared and nothing else, but for `sobol`: that is what people get who choose nothing.
METHODS: dict[str, dict[str, object]] = {
    "prb": {"type": "prb"},
    "prb_basic": {"type": "prb_basic"},
    "naive AD": {"type": "naive_ad"},
    "RB": {"type": "radiative_backprop"},
    "linear RB": {"type": "radiative_backprop", "linear": True},
    "sweep": {"type": "pathreplay", "adjoint": "recorded", "sampling": "scene", "boundary": "none"},
    "replay": {"type": "pathreplay", "adjoint": "replay", "sampling": "scene", "boundary": "none"},
    "boundary and interior": {"type": "pathreplay", "boundary": "all"},
    "all boundaries": {"type": "pathreplay", "boundary": "all", "sampling": "scene"},
    "prb_projective": {"type": "prb_projective"},
    "unguided prb_projective": {"type": "prb_projective", "guiding": "none"},
    "edge list": {"type": "prb_projective", "sppc": 0, "sppi": 0},
    "projective secondary": {"type": "prb_projective", "sppc": 0, "sppp": 0},
    "unguided secondary": {"type": "prb_projective", "sppc": 0, "sppp": 0, "guiding": "none"},
    "volpath": {"type": "volpath"},
    "prbvolpath": {"type": "prbvolpath"},
    "score": {"type": "pathreplay", "sampling": "scene"},
    "auto": {"type": "pathreplay", "sampling": "scene"},
    "sobol": {"type": "pathreplay"},
    "no branch": {"type": "pathreplay", "null_branching": False, "sampling": "scene"},
    "listing": {"type": "prb_volume_listing"},
    "particles": {"type": "pathreplay_particles", "boundary": "none"},
    "ptracer": {"type": "ptracer"},
}

#: Integrators without an adjoint of their own.
PLAIN_AD = ("ptracer",)

#: Mitsuba's own: what ours is compared with, and not held to anything when two records are compared.
STOCK = (
    "prb",
    "prb_basic",
    "prb_projective",
    "unguided prb_projective",
    "edge list",
    "projective secondary",
    "unguided secondary",
    "prbvolpath",
    "volpath",
    "path",
    "ptracer",
    "finite differences",
    "central difference",
    "half steps",
)

#: Two pictures with the same random numbers, as one does without gradients.
DIFFERENCE = "central difference"

#: Ways: the loop of an optimisation step, whether a step was recorded, and what a new process does first.
USUAL, OWN = "usual loop", "own loop"
TRACED, RECORDED = "traced", "recorded"
STAGES = ("import", "first gradient", "second gradient", "half the samples")


def parts(method: str) -> tuple[str, str]:
    """Split the name of a method into integrator and way; the way is empty if there is none."""
    integrator, _, way = method.partition(", ")
    return integrator, way
