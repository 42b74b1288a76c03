"""`dielectric_ad` has the values of Mitsuba's `dielectric`, and derivatives that agree with float64 optics."""

from __future__ import annotations

import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pathreplay  # noqa: F401 (registers the plugin)
from pathreplay.platform.threads import spare_thread
from pathreplay.plugins.dielectric_ad import MAX_REFLECTION

N = 20000
RADIANCE, IMPORTANCE = "Radiance", "Importance"
CONTEXTS = {
    "both lobes": {},
    "component 0": {"component": 0},
    "component 1": {"component": 1},
    "component 7": {"component": 7},
    "type reflection": {"type_mask": "DeltaReflection"},
    "type transmission": {"type_mask": "DeltaTransmission"},
    "type diffuse": {"type_mask": "DiffuseReflection"},
}


def context(mode: str = RADIANCE, component: int | None = None, type_mask: str | None = None):
    ctx = mi.BSDFContext(getattr(mi.TransportMode, mode))
    if component is not None:
        ctx.component = component
    if type_mask is not None:
        ctx.type_mask = getattr(mi.BSDFFlags, type_mask)
    return ctx


def interaction(wi: np.ndarray):
    """Interactions seen from the directions `wi`, shape (n, 3)."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.wi = mi.Vector3f(*wi.T.astype(np.float32))
    si.t = mi.Float(1)
    si.uv = mi.Point2f(np.linspace(0, 1, len(wi), dtype=np.float32), 0.3)
    return si


def directions(n: int = N, seed: int = 1) -> np.ndarray:
    """Uniform on the sphere, one in ten of them close to grazing, as float32 numbers."""
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(n, 3))
    v[::10, 2] *= 1e-3
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


def uniform(n: int = N, seed: int = 2):
    return mi.Float(np.random.default_rng(seed).random(n, dtype=np.float32))


def checkerboard():
    return {"type": "checkerboard", "color0": 0.25, "color1": {"type": "rgb", "value": [0.9, 0.4, 0.7]}}


# ----------------------------------------------------------------------------------------------------------------------
#  Values
# ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [RADIANCE, IMPORTANCE])
@pytest.mark.parametrize("name", CONTEXTS)
@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"int_ior": "diamond", "ext_ior": "water"},
        {"int_ior": 1.1, "ext_ior": 1.9},
        {"int_ior": 1.4, "ext_ior": 1.4},
        {"specular_reflectance": 0.3, "specular_transmittance": "checkerboard"},
    ],
    ids=lambda p: "-".join(map(str, p.values())) or "default",
)
def test_samples_equal_those_of_dielectric(parameters, name, mode):
    parameters = {key: checkerboard() if value == "checkerboard" else value for key, value in parameters.items()}
    si, ctx, sample1 = interaction(directions()), context(mode, **CONTEXTS[name]), uniform()
    active = mi.Mask(np.arange(N) % 7 != 0)
    (bs, weight), (bs_ref, weight_ref) = (
        mi.load_dict({"type": kind, **parameters}).sample(ctx, si, sample1, mi.Point2f(0.5), active)
        for kind in ("dielectric_ad", "dielectric")
    )
    critical = near_critical(si, parameters) if name == "both lobes" else mi.Mask(False)
    for field in ("wo", "pdf", "eta", "sampled_component", "sampled_type"):
        assert dr.all(critical | (getattr(bs, field) == getattr(bs_ref, field)), axis=None), field
    assert dr.all(critical | (weight == weight_ref), axis=None)
    if name == "both lobes":
        assert dr.any(weight > 0, axis=None) and dr.count(critical)[0] < N / 10


def near_critical(si, parameters):
    """Where the two plugins choose between the lobes with different probabilities."""
    eta = mi.traverse(mi.load_dict({"type": "dielectric_ad", **parameters}))["eta"]
    F, _, η_it, _ = mi.fresnel(mi.Frame3f.cos_theta(si.wi), eta)
    return (η_it < 1) & (F > MAX_REFLECTION) & (F < 1)


def test_transmission_is_likely_near_the_critical_angle():
    """A quarter of the samples or more, and the same mean weights as if each lobe were drawn by itself."""
    bsdf = mi.load_dict({"type": "dielectric_ad", "int_ior": 1.5, "ext_ior": 1.0})
    θ = np.arcsin(1 / 1.5) * 0.9999
    si = interaction(np.tile([np.sin(θ), 0, -np.cos(θ)], (N, 1)))
    bs, weight = bsdf.sample(context(), si, uniform(), mi.Point2f(0.5))
    F, *_ = mi.fresnel(mi.Frame3f.cos_theta(si.wi), mi.Float(1.5))
    assert MAX_REFLECTION < F[0] < 1
    reflected = bs.sampled_component == 0
    assert np.allclose(np.unique(bs.pdf), [1 - MAX_REFLECTION, MAX_REFLECTION])
    assert abs(dr.count(reflected)[0] / N - MAX_REFLECTION) < 4 * np.sqrt(3 / 16 / N)
    assert np.allclose(dr.select(reflected, weight[0] * bs.pdf, F), F)
    assert np.allclose(dr.select(reflected, 1 - F, weight[0] * bs.pdf * 1.5**-2), 1 - F)


def test_flags_and_parameters_are_those_of_dielectric():
    tints = {"specular_reflectance": checkerboard(), "specular_transmittance": 0.5}
    ours, stock = (mi.load_dict({"type": kind, **tints}) for kind in ("dielectric_ad", "dielectric"))
    assert ours.component_count() == 2 and ours.flags() == stock.flags()
    assert [ours.flags(i) for i in range(2)] == [stock.flags(i) for i in range(2)]
    params = mi.traverse(ours)
    assert set(params.keys()) == set(mi.traverse(stock).keys())
    assert params["eta"][0] == np.float32(mi.traverse(stock)["eta"])
    assert params.flags("eta") == mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
    assert "eta" in str(ours) and "specular_reflectance" in str(ours)


def test_eval_and_pdf_are_zero():
    bsdf, si, ctx = mi.load_dict({"type": "dielectric_ad"}), interaction(directions(16)), context()
    value, pdf = bsdf.eval_pdf(ctx, si, mi.reflect(si.wi))
    assert dr.all(value == 0, axis=None) and dr.all(pdf == 0)
    assert dr.all(bsdf.eval(ctx, si, mi.reflect(si.wi)) == 0, axis=None) and dr.all(bsdf.pdf(ctx, si, si.wi) == 0)


def test_integers_are_indices_too():
    assert mi.traverse(mi.load_dict({"type": "dielectric_ad", "int_ior": 2, "ext_ior": 1}))["eta"][0] == 2


@pytest.mark.parametrize(
    "parameters, words",
    [
        ({"int_ior": -1.5}, "int_ior is -1.5; give a finite index of refraction above 0"),
        ({"ext_ior": 0.0}, "ext_ior is 0;"),
        ({"int_ior": "unobtainium"}, "unobtainium"),
        ({"ior": 1.5}, "ior"),
    ],
)
def test_bad_parameters_are_named(parameters, words):
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict({"type": "dielectric_ad", **parameters})


def test_new_index_compiles_no_new_kernel():
    bsdf, si = mi.load_dict({"type": "dielectric_ad", "int_ior": 1.5}), interaction(directions(64))
    params = mi.traverse(bsdf)
    hashes, values = [], []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for eta in (1.3, 1.4):
            params["eta"] = mi.Float(eta)
            params.update()
            dr.kernel_history_clear()
            bs, _ = bsdf.sample(context(component=1), si, uniform(64), mi.Point2f(0.5))
            values.append(bs.wo.numpy())
            hashes.append([k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])])
    assert hashes[0] and hashes[0] == hashes[1]
    assert not np.allclose(*values)


# ----------------------------------------------------------------------------------------------------------------------
#  Derivatives
# ----------------------------------------------------------------------------------------------------------------------


def optics(wi: np.ndarray, eta: float, lobe: int, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Direction (n, 3) and value f (n,) of one lobe, from Snell's law and Fresnel's equations in float64."""
    c, relative = np.abs(wi[:, 2]), np.where(wi[:, 2] >= 0, eta, 1 / eta)
    cos_t = np.sqrt(np.maximum(1 - (1 - c**2) / relative**2, 0))
    with np.errstate(invalid="ignore"):
        s, p = (c - relative * cos_t) / (c + relative * cos_t), (relative * c - cos_t) / (relative * c + cos_t)
    F = (s**2 + p**2) / 2
    if lobe == 0:
        return wi * [-1, -1, 1], F
    wo = np.stack([-wi[:, 0] / relative, -wi[:, 1] / relative, -np.sign(wi[:, 2]) * cos_t], axis=1)
    return wo, (1 - F) * (relative**-2 if mode == RADIANCE else 1)


def cos_t_squared(wi: np.ndarray, eta: float) -> np.ndarray:
    return 1 - (1 - wi[:, 2].astype(float) ** 2) / np.where(wi[:, 2] >= 0, eta, 1 / eta) ** 2


def derivative(bsdf, wi, tangent, v_eta: float, ctx, sample1):
    """Forward derivative of (wo, weight), and the sample, along (tangent of wi, v_eta)."""
    params, si = mi.traverse(bsdf), interaction(wi)
    x = mi.Float(0)
    dr.enable_grad(x)
    si.wi = si.wi + x * mi.Vector3f(*tangent.T.astype(np.float32))
    params["eta"] = dr.detach(params["eta"]) + x * v_eta
    params.update()
    bs, weight = bsdf.sample(ctx, si, sample1, mi.Point2f(0.5))
    dr.set_grad(x, 1)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    d_wo, d_weight = dr.grad(bs.wo).numpy().T, dr.grad(weight).numpy().T
    assert not dr.grad_enabled(bs.pdf)
    params["eta"] = dr.detach(params["eta"])
    params.update()
    return d_wo, d_weight, bs


def tangents(wi: np.ndarray, seed: int = 3) -> np.ndarray:
    """Unit tangents of the sphere at wi: a derivative with respect to a direction is one along these."""
    v = np.cross(wi.astype(float), np.random.default_rng(seed).normal(size=wi.shape))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.mark.parametrize("mode", [RADIANCE, IMPORTANCE])
@pytest.mark.parametrize("components", ["both", "0", "1"])
@pytest.mark.parametrize("variable", ["eta", "wi"])
@pytest.mark.parametrize("eta", [1.5, 0.7, 1.0])
def test_derivatives_against_float64_differences(eta, variable, components, mode):
    wi = directions(4000)
    # Within 1e-2 of the critical angle (and 1e-3 of grazing) float32 keeps too few digits of cos² θ_t for a comparison.
    wi = wi[(np.abs(cos_t_squared(wi, eta)) > 1e-2) & (np.abs(wi[:, 2]) > 1e-3)]
    v_wi, v_eta = (tangents(wi), 0.0) if variable == "wi" else (np.zeros_like(wi, float), 1.0)
    ctx = context(mode, component=None if components == "both" else int(components))
    bsdf = mi.load_dict({"type": "dielectric_ad", "int_ior": eta, "ext_ior": 1.0, "specular_reflectance": 0.8})
    d_wo, d_weight, bs = derivative(bsdf, wi, v_wi, v_eta, ctx, uniform(len(wi)))

    h, at = 1e-7, wi.astype(float)
    at /= np.linalg.norm(at, axis=1, keepdims=True)
    eta32 = float(mi.traverse(bsdf)["eta"][0])
    component, pdf = bs.sampled_component.numpy(), bs.pdf.numpy()
    for lobe in (0, 1):
        # Total reflection has no transmitted direction; where that lobe is asked for all the same, its weight is zero.
        chosen = (component == lobe) & ((lobe == 0) | (cos_t_squared(wi, eta) > 0))
        assert chosen.any() == (components in ("both", str(lobe)) and (lobe, eta, components) != (0, 1.0, "both"))
        if not chosen.any():
            continue
        (wo_hi, f_hi), (wo_lo, f_lo) = (optics(at + s * h * v_wi, eta32 + s * h * v_eta, lobe, mode) for s in (1, -1))
        ref_wo, ref_f = (wo_hi - wo_lo) / (2 * h), (f_hi - f_lo) / (2 * h)
        ref_weight = ref_f * (0.8 if lobe == 0 else 1) / pdf
        # Relative to one plus the derivative; float32 rounding grown by 1 / cos θ_t.
        error_wo = np.abs(d_wo - ref_wo).max(axis=1) / (1 + np.abs(ref_wo).max(axis=1))
        error_weight = np.abs(d_weight - ref_weight[:, None]).max(axis=1) / (1 + np.abs(ref_weight))
        assert error_wo[chosen].max() < 1e-5
        assert error_weight[chosen].max() < 1e-5


@pytest.fixture
def two_threads():
    """A pool of one computes in this thread, which does not take numbers below 1e-38 for zero as the pool's do."""
    with spare_thread():
        yield


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("eta", [1.5, 0.7, 1.0, 1 + 1e-6, 30.0])
@pytest.mark.parametrize("components", [None, 0, 1])
def test_derivatives_are_finite_everywhere(eta, components):
    critical = np.sqrt(max(1 - min(eta, 1 / eta) ** 2, 0))
    cosines = np.array([0, 1e-45, 1e-38, 1e-30, 1e-20, 1e-12, 1e-7, 1e-4, 0.5, 1], np.float32)
    near = np.float32(critical) + np.float32(6e-8) * np.arange(-8, 9, dtype=np.float32)
    cosines = np.concatenate([cosines, near[(near >= 0) & (near <= 1)]])
    cosines = np.concatenate([cosines, -cosines])
    wi = np.stack([np.sqrt(1 - cosines**2), np.zeros_like(cosines), cosines], axis=1)
    wi = np.concatenate([wi, [[0, 0, 0]]])  # an interaction that is none
    bsdf = mi.load_dict({"type": "dielectric_ad", "int_ior": eta, "ext_ior": 1.0})
    ctx = context(component=components)
    for sample1 in (0.0, 0.5, np.float32(1 - 2**-24)):
        for v_wi, v_eta in ((tangents(wi + 1e-3), 0.0), (np.zeros_like(wi), 1.0)):
            d_wo, d_weight, _ = derivative(bsdf, wi, v_wi, v_eta, ctx, mi.Float(sample1))
            assert np.isfinite(d_wo).all() and np.isfinite(d_weight).all()
        si, params = interaction(wi), mi.traverse(bsdf)
        dr.enable_grad(params["eta"], si.wi)
        bs, weight = bsdf.sample(ctx, si, mi.Float(sample1), mi.Point2f(0.5))
        assert dr.all(dr.isfinite(weight) & dr.isfinite(bs.pdf), axis=None)
        dr.backward(dr.sum(bs.wo, axis=None) + dr.sum(weight, axis=None))
        assert dr.all(dr.isfinite(dr.grad(si.wi)), axis=None) and dr.all(dr.isfinite(dr.grad(params["eta"])))
        dr.disable_grad(params["eta"])


def test_total_internal_reflection_is_that_of_a_mirror():
    wi = directions(1000)
    wi = wi[cos_t_squared(wi, 1.5) < -1e-3]
    bsdf = mi.load_dict({"type": "dielectric_ad", "int_ior": 1.5, "ext_ior": 1.0})
    for v_wi, v_eta in ((0 * wi, 1.0), (tangents(wi), 0.0)):
        d_wo, d_weight, bs = derivative(bsdf, wi, v_wi, v_eta, context(), uniform(len(wi)))
        assert len(wi) > 100 and dr.all(bs.sampled_component == 0)
        assert np.all(d_weight == 0) and np.any(d_wo != 0) == (v_eta == 0)


def test_tints_are_differentiated_down_to_zero():
    bsdf = mi.load_dict({"type": "dielectric_ad", "specular_reflectance": 0.0, "specular_transmittance": 0.0})
    params, si = mi.traverse(bsdf), interaction(directions(1000))
    tints = [params[f"{name}.value"] for name in ("specular_reflectance", "specular_transmittance")]
    dr.enable_grad(tints)
    bs, weight = bsdf.sample(context(mode=IMPORTANCE), si, uniform(1000), mi.Point2f(0.5))
    dr.backward(dr.sum(weight.x))
    reflected = int(np.sum(bs.sampled_component.numpy() == 0))
    assert [g[0] for g in map(dr.grad, tints)] == [reflected, 1000 - reflected] and 0 < reflected < 1000


# ----------------------------------------------------------------------------------------------------------------------
#  Statistics. Neither lobe has a density: Mitsuba's chi² adapter for BSDFs has nothing to compare with, and Mitsuba
#  itself does not test its `dielectric` so. Spread wi over a hemisphere, and wo has a density.
# ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("from_inside", [False, True])
def test_chi2_of_directions_under_diffuse_light(from_inside):
    """wi is cosine distributed, hence so is the reflected wo but for F, and the refracted one is by η² and 1 - F."""
    bsdf = mi.load_dict({"type": "dielectric_ad", "int_ior": 1.5, "ext_ior": 1.0})
    eta, side = mi.traverse(bsdf)["eta"], (-1 if from_inside else 1)
    relative = 1 / 1.5 if from_inside else 1.5

    def sample(u):
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(u))
        si.wi = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u[1], u[2]))
        si.wi.z *= side
        return bsdf.sample(context(), si, u[0], mi.Point2f(0))[0].wo

    def density(wo):
        F = mi.fresnel(wo.z, eta)[0]
        f = dr.select(wo.z * side > 0, F, (1 - F) * relative**2)
        return f * dr.abs(wo.z) / dr.pi

    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=sample,
        pdf_func=density,
        sample_dim=3,
        sample_count=200000,
        seed=7,
    )
    # Two tests, 1 % of false alarms over both.
    assert test.run(significance_level=0.01, test_count=2), test.messages


@pytest.mark.parametrize("cos_theta", [1.0, 0.5, 0.1, -0.9, -0.76])
def test_lobes_are_drawn_as_often_as_the_fresnel_term_says(cos_theta):
    n = 100000
    wi = np.tile([np.sqrt(1 - cos_theta**2), 0, cos_theta], (n, 1))
    bsdf = mi.load_dict({"type": "dielectric_ad", "int_ior": 1.5, "ext_ior": 1.0})
    bs, _ = bsdf.sample(context(), interaction(wi), uniform(n, seed=11), mi.Point2f(0.5))
    F = optics(wi[:1], 1.5, 0, RADIANCE)[1][0]
    z = (np.sum(bs.sampled_component.numpy() == 0) - n * F) / np.sqrt(n * F * (1 - F))
    assert abs(z) < 4


# ----------------------------------------------------------------------------------------------------------------------
#  Renderings
# ----------------------------------------------------------------------------------------------------------------------


def ball(kind: str, emitter: dict, **parameters):
    """A glass ball of radius 1 at the origin, seen from z = 4."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 1000, "rr_depth": 1000},
            "sensor": {
                "type": "perspective",
                "fov": 35,
                "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
            },
            "ball": {"type": "sphere", "glass": {"type": kind, **parameters}},
            "emitter": emitter,
        },
        optimize=False,
    )


@pytest.mark.parametrize("indices", [("bk7", "air"), (1.0, 1.5), (1.4, 1.4)])
def test_white_furnace(indices):
    scene = ball("dielectric_ad", {"type": "constant"}, int_ior=indices[0], ext_ior=indices[1])
    image = mi.render(scene, spp=16, seed=3).numpy()
    # But for rays near the critical angle, which are rare here and have two weights, there is no noise.
    off = np.abs(image - 1)
    assert np.median(off) < 1e-6 and off.max() < 0.05 and abs(image.mean() - 1) < 1e-4


def test_image_equals_that_of_dielectric():
    texels = mi.Bitmap(np.random.default_rng(5).random((8, 16, 3), dtype=np.float32))
    images = [
        mi.render(
            ball(kind, {"type": "envmap", "bitmap": texels}, int_ior=1.7, specular_transmittance=checkerboard()),
            spp=16,
            seed=4,
        ).numpy()
        for kind in ("dielectric_ad", "dielectric")
    ]
    same = (images[0] == images[1]).all(-1)
    assert same.mean() > 0.9 and images[0].std() > 0.1  # the others have a ray near the critical angle
    assert abs(images[0].mean() / images[1].mean() - 1) < 1e-3


def test_image_derivative_through_two_refractions():
    """Camera ray, into the ball, out of it, a smooth environment: derivative in η through Mitsuba's virtual calls."""
    scene = ball("dielectric_ad", {"type": "constant"}, int_ior=1.5, ext_ior=1.0)
    params = mi.traverse(scene)
    i = mi.Float(np.linspace(-0.6, 0.6, 64, dtype=np.float32))
    origin, only_refraction = mi.Point3f(i, 0.3 * i + 0.1, 4), context(component=1)

    def radiance(eta):
        params["ball.bsdf.eta"] = mi.Float(eta)
        params.update()
        ray, weight = mi.Ray3f(origin, mi.Vector3f(0, 0, -1)), mi.Float(1)
        for _ in range(2):
            si = scene.ray_intersect(ray)
            bs, w = si.bsdf(ray).sample(only_refraction, si, mi.Float(0.5), mi.Point2f(0.5))
            ray, weight = si.spawn_ray(si.to_world(bs.wo)), weight * w.x
        return weight * (1 + ray.d.x + ray.d.y * ray.d.z)

    eta = mi.Float(1.5)
    dr.enable_grad(eta)
    value = radiance(eta)
    dr.set_grad(eta, 1)
    gradient = dr.forward_to(value)
    reference = (radiance(mi.Float(1.505)) - radiance(mi.Float(1.495))).numpy() / 0.01
    assert np.abs(gradient.numpy() - reference).max() < 1e-3 * np.abs(reference).max()
    assert np.abs(reference).max() > 0.5


# ----------------------------------------------------------------------------------------------------------------------
#  Other variants, each in the same fresh process: plugins belong to the variant that they were registered in
# ----------------------------------------------------------------------------------------------------------------------

OTHER_VARIANTS = """
import pathreplay, drjit as dr, mitsuba as mi, numpy as np
for variant in ("llvm_ad_spectral", "llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(variant)
    wi = np.random.default_rng(1).normal(size=(3, 1000))
    wi /= np.linalg.norm(wi, axis=0)
    tint = {"specular_reflectance": 0.5, "specular_transmittance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}}
    samples = []
    for kind in ("dielectric_ad", "dielectric"):
        si = dr.zeros(mi.SurfaceInteraction3f, 1000)
        si.wi = mi.Vector3f(wi)
        si.wavelengths = 550 if variant == "llvm_ad_spectral" else []
        bsdf = mi.load_dict({"type": kind, **tint})
        if kind == "dielectric_ad":
            eta = mi.traverse(bsdf)["eta"]
            dr.enable_grad(eta)
        sample1 = mi.Float(np.linspace(0, 0.999, 1000))
        samples.append(bsdf.sample(mi.BSDFContext(), si, sample1, mi.Point2f(0.5)))
    (bs, weight), (bs_ref, weight_ref) = samples
    assert dr.all(bs.wo == bs_ref.wo, axis=None) and dr.all(bs.pdf == bs_ref.pdf), variant
    assert dr.all(weight == weight_ref, axis=None), variant
    dr.backward(dr.sum(weight, axis=None) + dr.sum(bs.wo, axis=None))
    assert np.isfinite(dr.grad(eta)[0]) and dr.grad(eta)[0] != 0, variant
    print(variant, "agrees")
mi.set_variant("llvm_ad_rgb_polarized" if "llvm_ad_rgb_polarized" in mi.variants() else "llvm_ad_mono_polarized")
try:
    mi.load_dict({"type": "dielectric_ad"})
except RuntimeError as error:
    print(error)
"""


def test_spectral_and_mono_variants_agree_and_polarised_ones_are_refused():
    done = subprocess.run([sys.executable, "-c", OTHER_VARIANTS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [f"{v} agrees" in done.stdout for v in ("llvm_ad_spectral", "llvm_ad_mono", "llvm_ad_rgb")] == [True] * 3
    assert "dielectric_ad: the polarised variant llvm_ad_mono_polarized is not supported" in done.stdout
