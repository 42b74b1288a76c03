"""Measures the surface error of the example that recovers a mesh from silhouettes and shadows.

    python -m benchmarks.edges_mesh

The command runs examples/mesh-by-shadows and prints root mean square distances for the initial and the final mesh: from
the vertices of the mesh to the true surface, and from points of the true surface to the vertices. The length of the
body is 1.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from pathreplay.jobs import load_config, optimize
from pathreplay.scenes.bodies import ball, knobs

EXAMPLE = Path(__file__).parent.parent / "examples/mesh-by-shadows/config.toml"
FINE = 6  # subdivisions: points of the true surface are 0.01 apart


def distances(points: np.ndarray) -> str:
    truth = knobs(ball(FINE)[0])
    there, back = cKDTree(truth).query(points)[0], cKDTree(points).query(truth)[0]
    return f"{np.sqrt(np.mean(there**2)):.4f} to the truth, {np.sqrt(np.mean(back**2)):.4f} from it"


def main() -> None:
    """Run the job, and print its errors."""
    with tempfile.TemporaryDirectory() as folder:
        result = optimize(load_config(EXAMPLE), output=Path(folder) / "mesh")
    print(result.describe())
    print(f"seconds: {sum(entry.seconds for entry in result.history):.0f}")
    print(f"ball:   {distances(0.3 * ball(4)[0])}")
    print(f"result: {distances(result.parameters['body.vertex_positions'].reshape(-1, 3))}")
    print(f"as fine as the result, exact: {distances(knobs(ball(4)[0]))}")


if __name__ == "__main__":
    main()
