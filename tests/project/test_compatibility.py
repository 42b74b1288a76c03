"""docs/reference/compatibility.md: it has every plugin of Mitsuba 3.9, and what it says of rarely used ones is true."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay import check_gradient
from places import ROOT
from variant import VARIANT

PAGE = (ROOT / "docs/reference/compatibility.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.*?)$\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S))

#: The plugins that Mitsuba 3.9.1 declares in src/*/CMakeLists.txt and in src/python/python/ad/integrators.
PLUGINS = {
    "BSDFs": """blendbsdf bumpmap circular conductor dielectric diffuse hair mask measured measured_polarized normalmap
        null plastic polarizer pplastic principled principledthin retarder roughconductor roughdielectric roughplastic
        thindielectric twosided""",
    "Shapes": """blender bsplinecurve cube cylinder disk ellipsoids ellipsoidsmesh instance linearcurve merge obj ply
        rectangle sdfgrid serialized shapegroup sphere""",
    "Emitters": "area constant directional directionalarea envmap point projector spot sunsky timed_sunsky",
    "Sensors": "batch distant irradiancemeter orthographic perspective radiancemeter thinlens",
    "Films, filters and samplers": """hdrfilm specfilm box catmullrom gaussian lanczos mitchell tent independent
        ldsampler multijitter orthogonal stratified""",
    "Media, phase functions and volumes": """heterogeneous homogeneous blendphase hg isotropic rayleigh sggx tabphase
        constvolume gridvolume""",
    "Textures and spectra": """bitmap checkerboard mesh_attribute volume blackbody d65 irregular rawconstant regular
        srgb uniform""",
    "Integrators": """aov depth direct moment path ptracer stokes volpath volpathmis direct_projective prb prb_basic
        prb_projective prbvolpath volprim_rf_basic""",
}
IN_PYTHON = {"direct_projective", "prb", "prb_basic", "prb_projective", "prbvolpath", "volprim_rf_basic"}


def rows(section: str) -> list[str]:
    """The plugins in the first column of the table of a section."""
    return [
        name for row in re.findall(r"^\| (`.*?) \|", SECTIONS[section], re.M) for name in re.findall(r"`(\w+)`", row)
    ]


@pytest.mark.parametrize("section", PLUGINS)
def test_every_plugin_has_a_row(section: str) -> None:
    assert sorted(rows(section)) == sorted(PLUGINS[section].split())


def test_the_list_is_that_of_the_installed_mitsuba() -> None:
    listed = {name for names in PLUGINS.values() for name in names.split()} - IN_PYTHON
    installed = {
        path.stem for path in (Path(mi.__file__).parent / "plugins").iterdir() if path.suffix in (".so", ".dll")
    }
    assert installed == listed


def test_every_variant_has_a_row() -> None:
    assert sorted(rows("Variants")) == sorted(mi.variants())


# ------------------------------ What no other test has ------------------------------


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def view(**sensor: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "fov": 40, "to_world": look, "film": film, **sensor}


def world(**more: Any) -> dict[str, Any]:
    """A floor and a ball under a sky; objects are replaced by ``more``."""
    T = mi.ScalarTransform4f
    floor = {
        "type": "rectangle",
        "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3),
        "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.4, 0.3)},
    }
    integrator = {"type": "path", "max_depth": 4}
    sky = {"type": "constant", "radiance": 0.5}
    scene = {"type": "scene", "integrator": integrator, "camera": view(), "sky": sky, "floor": floor}
    return {**scene, "ball": {"type": "sphere"}, **more}


def curve(folder: Path, kind: str) -> dict[str, Any]:
    path = folder / "curve.txt"
    path.write_text("-1 0 0 0.2\n0 0.5 0 0.25\n1 0 0 0.2\n1.5 -0.5 0 0.2\n")
    return world(ball={"type": kind, "filename": str(path)})


def ellipsoids(kind: str) -> dict[str, Any]:
    one = {"centers": [0, 0, 0], "scales": [0.3, 0.3, 0.3], "quaternions": [0, 0, 0, 1]}
    return world(ball={"type": kind, **{key: mi.TensorXf(np.array([value], np.float32)) for key, value in one.items()}})


def distance_grid() -> dict[str, Any]:
    at = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 3, indexing="ij"), -1)
    grid = (np.linalg.norm(at, axis=-1) - 0.35).astype(np.float32)[..., None]
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    return world(ball={"type": "sdfgrid", "grid": mi.TensorXf(grid), "to_world": place})


def volume_texture() -> dict[str, Any]:
    data = np.random.default_rng(0).uniform(0.2, 0.8, (2, 2, 2, 3)).astype(np.float32)
    place = mi.ScalarTransform4f().translate(-3).scale(6)
    grid = {"type": "gridvolume", "data": mi.TensorXf(data), "to_world": place}
    scene = world()
    scene["floor"]["bsdf"]["reflectance"] = {"type": "volume", "volume": grid}
    return scene


FLOOR = "floor.bsdf.reflectance.value"
THIN = {"type": "principledthin", "base_color": rgb(0.6, 0.3, 0.2), "spec_trans": 0.3, "roughness": 0.5}
CASES = {
    "principledthin": (lambda _: world(ball={"type": "sphere", "bsdf": THIN}), "ball.bsdf.base_color.value"),
    "hair": (
        lambda _: world(ball={"type": "cylinder", "p0": [-1, 0, 0], "p1": [1, 0, 0], "bsdf": {"type": "hair"}}),
        FLOOR,
    ),
    "sunsky": (lambda _: world(sky={"type": "sunsky", "sun_direction": [0.3, 1, 0.2]}), FLOOR),
    "linearcurve": (lambda folder: curve(folder, "linearcurve"), FLOOR),
    "bsplinecurve": (lambda folder: curve(folder, "bsplinecurve"), FLOOR),
    "ellipsoids": (lambda _: ellipsoids("ellipsoids"), FLOOR),
    "ellipsoidsmesh": (lambda _: ellipsoids("ellipsoidsmesh"), FLOOR),
    "sdfgrid": (lambda _: distance_grid(), FLOOR),
    "d65": (
        lambda _: world(lamp={"type": "point", "position": [1, 3, 2], "intensity": {"type": "d65", "scale": 3.0}}),
        FLOOR,
    ),
    "rawconstant": (
        lambda _: world(ball={"type": "sphere", "bsdf": {**THIN, "roughness": {"type": "rawconstant", "value": 0.4}}}),
        FLOOR,
    ),
    "volume": (lambda _: volume_texture(), "floor.bsdf.reflectance.volume.data"),
    "batch": (lambda _: world(camera={"type": "batch", "film": view()["film"], "a": view(), "b": view(fov=50)}), FLOOR),
}


def same_image(scene: mi.Scene) -> None:
    """As that of `path`, sample by sample."""
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 4, "sampling": "scene"})
    image, expected = (np.array(mi.render(scene, integrator=i, spp=4, seed=1)) for i in (ours, scene.integrator()))
    assert np.any(expected) and np.abs(image - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_image_and_gradient(name: str, tmp_path: Path) -> None:
    make, key = CASES[name]
    scene = mi.load_dict(make(tmp_path), optimize=False)
    same_image(scene)
    result = check_gradient(scene, key, integrator="pathreplay", seeds=6, spp=16)
    assert result.passed, str(result)


@pytest.mark.parametrize("kind", ["radiancemeter", "distant"])
def test_images_of_sensors_without_a_film_of_pixels(kind: str) -> None:
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at([0, 1, 4], [0, -1, 0], [0, 1, 0])
    place = {"to_world": look} if kind == "radiancemeter" else {"direction": [0, -1, -0.5], "target": [0, -1, 0]}
    same_image(mi.load_dict(world(camera={"type": kind, "film": film, **place})))


def test_an_image_of_an_irradiance_meter() -> None:
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    scene = world(ball={"type": "sphere", "meter": {"type": "irradiancemeter", "film": film}})
    del scene["camera"]
    same_image(mi.load_dict(scene))


@pytest.mark.parametrize("outer", [{"type": "moment"}, {"type": "aov", "aovs": "depth:depth"}])
def test_images_within_other_integrators(outer: dict[str, Any]) -> None:
    inner = {"type": "pathreplay", "max_depth": 3}
    image = mi.render(mi.load_dict(world()), integrator=mi.load_dict({**outer, "inner": inner}), spp=4)
    assert image.shape[2] > 3 and np.isfinite(np.array(image)).all()


def test_paths_of_mitsuba_do_not_render_a_timed_sky() -> None:
    """Else the page has to be changed."""
    scene = mi.load_dict(world(sky={"type": "timed_sunsky"}))
    with pytest.raises(RuntimeError):
        dr.eval(mi.render(scene, spp=1))


SPECTRA = {
    "irregular": {"wavelengths": "400,500,600,700", "values": "1,2,3,2"},
    "regular": {"wavelength_min": 400, "wavelength_max": 700, "values": "1,2,3"},
    "blackbody": {"temperature": 4000},
}


@pytest.mark.slow
def test_spectra_in_spectral_variants(run_python: Any) -> None:
    code = f"""
import pathreplay
import mitsuba as mi
import numpy as np

mi.set_variant({VARIANT.replace("_rgb", "_spectral")!r})
look = mi.ScalarTransform4f().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0])
film = {{"type": "hdrfilm", "width": 8, "height": 8}}
for kind, options in {SPECTRA!r}.items():
    lamp = {{"type": "point", "position": [1, 3, 2], "intensity": {{"type": kind, **options}}}}
    camera = {{"type": "perspective", "to_world": look, "film": film}}
    scene = mi.load_dict({{"type": "scene", "camera": camera, "lamp": lamp, "ball": {{"type": "sphere"}}}})
    integrators = ({{"type": "path"}}, {{"type": "pathreplay", "sampling": "scene"}})
    a, b = (
        np.array(mi.render(scene, integrator=mi.load_dict({{**i, "max_depth": 4}}), spp=4, seed=1)) for i in integrators
    )
    assert a.max() > 0 and abs(a - b).max() < 1e-5 * a.max(), kind
"""
    done = run_python(code)
    assert done.returncode == 0, done.stderr
