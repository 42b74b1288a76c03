"""Seconds of an iteration by one process and by actors of Ray, of a job with many views.

    python -m benchmarks.actors [--scene surfaces] [--views 32] [--actors 1 --actors 2] [--iterations 12]

recovers the texture of a floor (`surfaces`; passes are recorded) or the density of a cloud (`cloud`; they are not).

Actors and the process have one thread each. The first iterations compile and record kernels and are not counted; of the
others the median counts. Prints a table, with the share of one actor's time. Wants `pip install 'pathreplay[ray]'`,
and as many cores as actors that do nothing else.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Literal

import drjit as dr
import typer

from pathreplay.inverse import iterate, make_config

COMPILING = {"surfaces": 4, "cloud": 1}
"""Iterations: kernels are traced, then recorded; an actor that takes a view of another does both once more."""

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">
  <rotate y="1" angle="{angle}"/><lookat origin="0,2,4" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="{size}"/><integer name="height" value="{size}"/>
  <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>"""
ROOM = """<scene version="3.0.0">{sensors}
<shape type="rectangle" id="floor"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
  <bsdf type="diffuse"><texture type="checkerboard" name="reflectance"/></bsdf></shape>
<shape type="sphere" id="ball"><transform name="to_world"><scale value="0.6"/><translate y="0.6"/></transform>
  <bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf></shape>
<emitter type="constant"/></scene>"""


def _job(scene: str, views: int, resolution: int) -> tuple[dict[str, Any], str]:
    """What the job says of its scene, and the scene's file, if it has one."""
    if scene == "cloud":
        density = {"*.sigma_t.data": 2.0}
        return {
            "scene": "cloud",
            "scene_parameters": {"views": views, "resolution": resolution, "grid": 16},
            "parameters": [{"key": "*.sigma_t.data", "initial": 1.0, "lower": 0.0}],
            "target": {"values": density, "spp": 4, "integrator": {"type": "volpath", "max_depth": 6}},
        }, ""
    sensors = "\n".join(SENSOR.format(angle=360 * n / views, size=resolution) for n in range(views))
    return {
        "scene": "room.xml",
        "parameters": [{"key": "floor.bsdf.reflectance.color?.value", "initial": 0.5, "lower": 0.0, "upper": 1.0}],
        "target": {"scene": "room.xml", "spp": 4},
    }, ROOM.format(sensors=sensors)


def main(
    scene: Annotated[Literal["surfaces", "cloud"], typer.Option(help="What is recovered.")] = "surfaces",
    views: Annotated[int, typer.Option(help="Cameras on a circle around the scene.")] = 32,
    actors: Annotated[list[int] | None, typer.Option(help="How many; may be given several times.")] = None,
    iterations: Annotated[int, typer.Option(help="Of each run.")] = 12,
    resolution: Annotated[int, typer.Option(help="Pixels along each side of a view.")] = 64,
    spp: Annotated[int, typer.Option(help="Samples per pixel.")] = 16,
    only: Annotated[bool, typer.Option("--only", help="Only the actors, not this process.")] = False,
) -> None:
    """Time iterations, and print the table."""
    dr.set_thread_count(1)
    job, xml = _job(scene, views, resolution)
    job |= {"iterations": iterations, "spp": spp, "picture_spp": 1, "preview": {"share": 0}}
    rows = [] if only else [("this process", _seconds(job, xml, COMPILING[scene]))]
    for count in actors or [1, 2]:
        ray = {"executor": "ray", "ray": {"actors": count, "threads": 1}}
        rows.append((f"{count} {'actor' if count == 1 else 'actors'}", _seconds(job | ray, xml, COMPILING[scene])))
    one = next((seconds for name, seconds in rows if name == "1 actor"), rows[0][1])
    print(f"\n{scene}, {views} views of {resolution} x {resolution} pixels, {spp} samples each\n")
    print("| computed by | seconds | of one actor's |\n| --- | ---: | ---: |")
    for name, seconds in rows:
        print(f"| {name} | {seconds:.2f} | {seconds / one:.2f} |")


def _seconds(job: dict[str, Any], xml: str, compiling: int) -> float:
    """The median over the iterations that compile nothing."""
    with tempfile.TemporaryDirectory() as folder:
        if xml:
            (Path(folder) / "room.xml").write_text(xml, encoding="utf-8")
            job = {**job, "scene": f"{folder}/room.xml", "target": {**job["target"], "scene": f"{folder}/room.xml"}}
        with iterate(make_config({**job, "output": f"{folder}/run"})) as session:
            seconds = [state.entry.seconds for state in session]
    return median(seconds[compiling:])


if __name__ == "__main__":
    typer.run(main)
