"""A mesh from outlines and shadows: how far from the truth the example ends, as a surface.

    python -m benchmarks.edges_mesh

runs examples/mesh-by-shadows and prints root mean square distances at the start and at the end: of vertices from the
true surface, and of points of the true surface from the vertices. The body is 1 long.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from pathreplay.jobs import load_config, optimize
from pathreplay.scenes.bodies import ball, knobs

EXAMPLE = Path(__file__).parent.parent / "examples/mesh-by-shadows/config.toml"
FINE = 6  # splits: points of the true surface are 0.01 apart


def distances(points: np.ndarray) -> str:
    truth = knobs(ball(FINE)[0])
    there, back = cKDTree(truth).query(points)[0], cKDTree(points).query(truth)[0]
    return f"{np.sqrt(np.mean(there**2)):.4f} to the truth, {np.sqrt(np.mean(back**2)):.4f} from it"


def main() -> None:
    """Run the job; print what came of it."""
    with tempfile.TemporaryDirectory() as folder:
        result = optimize(load_config(EXAMPLE), output=Path(folder) / "mesh")
    print(result.describe())
    print(f"seconds: {sum(entry.seconds for entry in result.history):.0f}")
    print(f"ball:   {distances(0.3 * ball(4)[0])}")
    print(f"result: {distances(result.parameters['body.vertex_positions'].reshape(-1, 3))}")
    print(f"as fine as the result, exact: {distances(knobs(ball(4)[0]))}")


if __name__ == "__main__":
    main()
