"""The public interface (CONTRACT.md 6.1): arguments, results, exceptions and their messages."""

import numpy as np
import pytest
import torch
from diff_gaussian_rasterization import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    cpu_deep_copy_tuple,
    rasterize_gaussians,
)
from rasterizer_tools import activated, few, keywords, leaves, render

from tests.workloads.splat_scenes import settings

COVARIANCE = torch.eye(3)[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].repeat(3, 1)  # of three spheres


NAMES = (
    "image_height image_width tanfovx tanfovy bg scale_modifier viewmatrix projmatrix sh_degree campos prefiltered "
    "debug antialiasing"
)


def scene(n: int = 3, dtype: torch.dtype = torch.float32):
    raw, size = few(n, dtype=dtype)
    return activated(raw), settings(**size)


def call(splats, camera, **changes):
    """Call the public class with keywords, as users do."""
    return GaussianRasterizer(raster_settings=camera)(**(keywords(splats) | changes))


@pytest.mark.parametrize(
    "name, shape",
    [("opacities", (1, 3, 1)), ("opacities", (3,)), ("bg", (1, 3)), ("bg", (3, 1)), ("viewmatrix", (1, 4, 4)),
     ("colors_precomp", (3, 1, 3)), ("shs", (3, 25, 3)), ("image_height", float)],
)  # fmt: skip
def test_shapes_that_the_reference_takes_give_the_same_image(name, shape):
    splats, camera = scene()
    changes = {"shs": torch.nn.functional.pad(torch.cat([splats["sh_dc"], splats["sh_rest"]], 1), (0, 0, 0, 9))[:, :16]}
    if name == "colors_precomp":
        changes = {"shs": None, name: torch.rand(3, 3)}
    expected = call(splats, camera, **changes)
    if shape is float:
        camera = camera._replace(image_height=float(camera.image_height))
    elif name in camera._fields:
        camera = camera._replace(**{name: getattr(camera, name).reshape(shape)})
    elif name == "shs":
        changes[name] = torch.nn.functional.pad(changes[name], (0, 0, 0, 25 - changes[name].shape[1]), value=7.0)
    else:
        changes[name] = (splats | changes)[name].reshape(shape)
    for got, wanted in zip(call(splats, camera, **changes), expected, strict=True):
        assert torch.equal(got, wanted)


def test_settings_are_the_references_tuple():
    assert GaussianRasterizationSettings._fields[:13] == tuple(NAMES.split())
    # Our fields follow and have defaults, so that the reference's 13 stay valid by position and by name. The last of
    # these has one because 2023 did not know it.
    assert set(GaussianRasterizationSettings._fields[12:]) == set(GaussianRasterizationSettings._field_defaults)
    splats, camera = scene()
    by_place = GaussianRasterizationSettings(*camera[:13])
    assert torch.equal(call(splats, by_place)[0], call(splats, camera)[0])
    with pytest.raises(TypeError):
        GaussianRasterizationSettings(*camera[:11])


@pytest.mark.parametrize("name", ["prefiltered", "debug", "antialiasing", "inverse_depth"])
def test_flags_of_the_settings_are_checked(name):
    splats, camera = scene()
    for flag in (True, 1, np.True_, torch.tensor(True), torch.ones(1, dtype=torch.int32)):
        image = call(splats, camera._replace(**{name: flag}))[0]
        assert torch.equal(image, call(splats, camera._replace(**{name: True}))[0])
    for wrong in ("no", "False", "", 2, [True], torch.ones(2), float("nan")):
        with pytest.raises(TypeError, match=f"{name} must be True or False"):
            call(splats, camera._replace(**{name: wrong}))


def test_settings_of_2023_give_two_results():
    splats, camera = scene()
    inputs = leaves(splats)
    result = call(inputs, GaussianRasterizationSettings(*camera[:12]))
    assert isinstance(result, tuple) and len(result) == 2
    wanted = call(splats, camera._replace(antialiasing=False))
    assert torch.equal(result[0], wanted[0]) and torch.equal(result[1], wanted[1])
    result[0].sum().backward()
    assert inputs["means"].grad.any()


def test_three_results():
    splats, camera = scene()
    result = call(leaves(splats), camera)
    assert isinstance(result, tuple) and len(result) == 3
    color, radii, inverse_depth = result
    assert color.shape == (3, 7, 18) and inverse_depth.shape == (1, 7, 18)
    assert all(image.is_contiguous() and image.dtype == torch.float32 for image in (color, inverse_depth))
    assert radii.shape == (3,) and radii.dtype == torch.int32 and not radii.requires_grad
    assert call(splats, camera._replace(inverse_depth=False))[2] is None
    out = render(splats, camera, raw=False)  # the function
    assert all(torch.equal(*pair) for pair in zip(result, (out.color, out.radii, out.inverse_depth), strict=True))
    # By place, in the reference's order.
    sh = torch.cat([splats["sh_dc"], splats["sh_rest"]], 1)
    places = (splats["means"], torch.zeros(3, 3), splats["opacities"], sh, None, splats["scales"], splats["rotations"])
    assert torch.equal(GaussianRasterizer(camera)(*places, None)[0], color)
    # Parameters activated outside in float32, or inside; a power of two changes no bit of a normalised quaternion.
    raw, _ = few(3, dtype=torch.float32)
    images = [render(raw | {"rotations": factor * raw["rotations"]}, camera).color for factor in (1, 4)]
    torch.testing.assert_close(images[0], color, rtol=0, atol=2e-6)
    assert torch.equal(*images)
    longer = splats | {"rotations": splats["rotations"] * 1.2}  # these are taken as they are
    assert not torch.equal(call(longer, camera)[0], color)


def test_exactly_one_of_each_pair_of_alternatives():
    splats, camera = scene()
    for changes in (
        {"shs": None},
        {"colors_precomp": torch.rand(3, 3)},
        {"scales": None},
        {"rotations": None},
        {"scales": None, "rotations": None},
        {"cov3D_precomp": COVARIANCE},
        {"cov3D_precomp": COVARIANCE, "scales": None},
    ):
        with pytest.raises(Exception, match="exactly one"):
            call(splats, camera, **changes)
    call(splats, camera, shs=None, colors_precomp=torch.rand(3, 3))
    call(splats, camera, scales=None, rotations=None, cov3D_precomp=COVARIANCE)


@pytest.mark.parametrize("degree", [0, 3])
def test_no_gaussians_give_the_background(degree):
    splats, camera = scene()
    none = {name: t[:0] for name, t in splats.items()}
    color, radii, inverse_depth = call(none, camera._replace(sh_degree=degree))
    assert torch.equal(color, camera.bg.float()[:, None, None].expand(3, 7, 18))
    assert radii.shape == (0,) and not inverse_depth.any()
    inputs = leaves(none)
    render(inputs, camera, raw=False).color.sum().backward()
    for name, t in inputs.items():
        assert t.grad.shape == none[name].shape


def test_coefficients_beyond_the_degree_are_ignored():
    splats, camera = scene()
    for degree in (0, 1, 2):
        active, lower = (degree + 1) ** 2 - 1, camera._replace(sh_degree=degree)
        images, inputs = [], leaves(splats)
        inputs["sh_rest"].data[:, active:] = float("nan")
        for rest in (inputs["sh_rest"], splats["sh_rest"][:, :active]):
            images.append(render(inputs | {"sh_rest": rest}, lower, raw=False).color)
        assert torch.equal(*images)
        zeros = torch.nn.functional.pad(splats["sh_rest"][:, :active], (0, 0, 0, 15 - active))
        higher = render(splats | {"sh_rest": zeros}, camera, raw=False).color
        torch.testing.assert_close(images[0], higher, rtol=0, atol=1e-6)
        images[0].square().sum().backward()
        gradient = inputs["sh_rest"].grad
        assert gradient.shape == (3, 15, 3)
        assert gradient[:, :active].all() and not gradient[:, active:].any()
    shs = torch.randn(len(splats["means"]), 25, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    color, wanted = (call(splats, camera._replace(sh_degree=degree), shs=shs)[0] for degree in (4, 3))
    assert torch.equal(color, wanted)
    color.sum().backward()
    assert shs.grad[:, :16].any() and not shs.grad[:, 16:].any()


def test_strided_inputs_give_the_same_bits():
    splats, camera = scene()
    wanted = render(splats, camera, raw=False).color
    for name, t in splats.items():
        wide = torch.full((2 * t.shape[0], *t.shape[1:-1], 2 * t.shape[-1]), float("nan"))
        wide[::2, ..., ::2] = t
        assert torch.equal(render(splats | {name: wide[::2, ..., ::2]}, camera, raw=False).color, wanted), name
    features = torch.cat([splats["sh_dc"], splats["sh_rest"]], 1)  # as in the reference's callers
    sliced = splats | {"sh_dc": features[:, :1], "sh_rest": features[:, 1:]}
    assert torch.equal(render(sliced, camera, raw=False).color, wanted)
    gradient = torch.ones_like(wanted).mT.contiguous().mT  # a backward may get any strides
    inputs = leaves(splats)
    render(inputs, camera, raw=False).color.backward(gradient)
    plain = leaves(splats)
    render(plain, camera, raw=False).color.sum().backward()
    assert torch.equal(inputs["means"].grad, plain["means"].grad)


def test_the_band_of_degree_0_may_come_apart():
    """Callers of the accelerated branch pass dc and the rest by keyword."""
    splats, camera = scene()
    whole, apart = leaves(splats), leaves(splats)
    images = [call(whole, camera)[0], call(apart, camera, dc=apart["sh_dc"], shs=apart["sh_rest"])[0]]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    for name in splats:
        assert torch.equal(whole[name].grad, apart[name].grad)
    flat = camera._replace(sh_degree=0)
    assert torch.equal(call(splats, flat, dc=splats["sh_dc"], shs=None)[0], call(splats, flat)[0])
    with pytest.raises(Exception, match="exactly one"):
        call(splats, camera, dc=splats["sh_dc"], shs=None, colors_precomp=torch.rand(3, 3))


def _screen_gradient(splats, camera, leaf, made=lambda leaf: leaf):
    """The gradient of `leaf`, of which `made` makes the screen means of a call."""
    call(splats, camera, means2D=made(leaf))[0].square().sum().backward()
    return leaf.grad


def test_screen_means_of_any_kind_receive_the_gradient():
    splats, camera = scene()
    wanted = _screen_gradient(splats, camera, torch.zeros(3, 3, requires_grad=True))
    assert wanted[:, :2].any()
    for kind, leaf, made in [
        ("not a leaf", torch.zeros(3, 3), lambda t: t + 0),
        ("a view", torch.zeros(5, 6), lambda t: t[1:4, ::2]),
        ("expanded", torch.zeros(()), lambda t: t.expand(3, 3)),
        ("float64", torch.zeros(3, 3, dtype=torch.float64), lambda t: t),
        ("float16", torch.zeros(3, 3, dtype=torch.float16), lambda t: t),
    ]:
        got = _screen_gradient(splats, camera, leaf.requires_grad_(), made)
        assert got.dtype == leaf.dtype, kind
        if kind == "a view":
            got = got[1:4, ::2]
        if kind == "expanded":
            torch.testing.assert_close(got, wanted.sum())
        else:
            torch.testing.assert_close(got, wanted.to(got.dtype), msg=kind)


def test_screen_means_that_need_no_gradient_may_have_any_form():
    splats, camera = scene()
    wanted = call(splats, camera)[0]
    for means2D in (torch.zeros(3, 2), torch.zeros(0), torch.zeros(7, 3), torch.zeros(3, 3, dtype=torch.int64)):
        assert torch.equal(call(splats, camera, means2D=means2D)[0], wanted)
    with pytest.raises(ValueError, match=r"means2d must be \(3, 3\), got \(3, 2\)"):
        call(splats, camera, means2D=torch.zeros(3, 2, requires_grad=True))
    for shape in ((2, 3), (3, 2)):
        with pytest.raises(ValueError, match=r"means2d must be \(3, 3\), got"):
            render(splats, camera, torch.zeros(shape), raw=False)
    # Callers that need no gradient of theirs pass None.
    inputs = leaves(splats)
    image = call(inputs, camera, means2D=None)[0]
    assert torch.equal(image, wanted)
    image.sum().backward()
    assert inputs["means"].grad.any()


def test_empty_tensors_stand_for_none():
    splats, camera = scene()
    empty = torch.Tensor([])
    assert torch.equal(call(splats, camera, colors_precomp=empty, cov3D_precomp=empty)[0], call(splats, camera)[0])
    colors = torch.rand(3, 3)
    changes = {"colors_precomp": colors, "cov3D_precomp": COVARIANCE}
    got = call(splats, camera, shs=empty, scales=empty, rotations=empty, **changes)[0]
    assert torch.equal(got, call(splats, camera, shs=None, scales=None, rotations=None, **changes)[0])
    with pytest.raises(Exception, match="exactly one"):
        call(splats, camera, shs=empty)


def test_the_function_behind_the_class():
    splats, camera = scene()
    sh, empty = torch.cat([splats["sh_dc"], splats["sh_rest"]], 1), torch.Tensor([])
    shape = splats["scales"], splats["rotations"]
    means2d = torch.zeros(3, 3, requires_grad=True)
    places = (splats["means"], means2d, sh, empty, splats["opacities"], *shape, empty, camera)
    result = rasterize_gaussians(*places)
    for got, wanted in zip(result, call(splats, camera), strict=True):
        assert torch.equal(got, wanted)
    result[0].sum().backward()
    assert means2d.grad.any()
    assert len(rasterize_gaussians(*places[:-1], GaussianRasterizationSettings(*camera[:12]))) == 2
    # Of two alternatives the precomputed values count, as in the reference.
    colors = torch.rand(3, 3)
    both = rasterize_gaussians(splats["means"], None, sh, colors, splats["opacities"], *shape, COVARIANCE, camera)
    one = {"shs": None, "scales": None, "rotations": None, "colors_precomp": colors, "cov3D_precomp": COVARIANCE}
    assert torch.equal(both[0], call(splats, camera, **one)[0])


def test_copies_of_a_tuple_lie_on_the_cpu():
    tensor = torch.arange(3.0)
    copied = cpu_deep_copy_tuple((tensor, 7, None))
    assert isinstance(copied, tuple) and copied[1:] == (7, None)
    assert torch.equal(copied[0], tensor) and copied[0].data_ptr() != tensor.data_ptr()


def test_one_gradient_alone_is_that_among_all():
    splats, camera = scene()
    everything = leaves(splats)
    render(everything, camera, raw=False).color.sum().backward()
    for name in splats:
        inputs = splats | {name: splats[name].clone().requires_grad_()}
        render(inputs, camera, raw=False).color.sum().backward()
        assert torch.equal(inputs[name].grad, everything[name].grad)
    row = splats["opacities"][:, 0].clone().requires_grad_()
    render(splats | {"opacities": row}, camera, raw=False).color.sum().backward()
    assert torch.equal(row.grad, everything["opacities"].grad[:, 0])
    grad = torch.func.grad(lambda t: render(splats | {"means": t}, camera, raw=False).color.sum())(splats["means"])
    assert torch.equal(grad, everything["means"].grad)


def test_without_gradients_there_is_the_same_image_and_no_graph():
    """tests/test_costs.py: nor what a backward would need."""
    splats, camera = scene()
    trained = render(leaves(splats), camera, raw=False).color
    with torch.no_grad():
        for inputs in (splats, leaves(splats)):
            color = render(inputs, camera, raw=False).color
            assert color.grad_fn is None and torch.equal(color, trained)


def test_a_backward_that_has_nothing_to_go_on_says_what_is_wrong():
    splats, camera = scene()
    color = render(leaves(splats), camera, raw=False).color
    color.sum().backward(retain_graph=True)
    color.sum().backward()
    with pytest.raises(RuntimeError, match="second time"):  # torch's own
        color.sum().backward()
    debugged = render(leaves(splats), camera._replace(debug=True), raw=False).color
    with pytest.raises(FloatingPointError, match="gradient of .* not finite"):
        (debugged.sum() * float("inf")).backward()


WRONG = [
    ("means", torch.zeros(3, 2), r"means must be \(N, 3\), got \(3, 2\)"),
    ("means", torch.zeros(3, 3, dtype=torch.float16), "float32 or float64.*float16"),
    ("opacities", torch.zeros(2, 1), r"opacities must be \(3, 1\).*got \(2, 1\)"),
    ("scales", torch.zeros(3, 1), r"scales must be \(3, 3\) \(activated.*\), got \(3, 1\)"),
    ("rotations", torch.zeros(3, 3), r"rotations must be \(3, 4\), got \(3, 3\)"),
    ("sh_dc", torch.zeros(3, 3), r"sh_dc must be \(3, 1, 3\), got \(3, 3\)"),
    ("sh_rest", torch.zeros(3, 8, 3), r"15 or more, 3\) for sh_degree 3, got \(3, 8, 3\)"),
    ("sh_rest", torch.zeros(2, 15, 3), r"sh_rest must be \(3"),
    ("sh_dc", torch.zeros(3, 1, 3, dtype=torch.float64), "sh_dc must be torch.float32.*float64"),
    ("scales", None, "give scales and rotations, or cov3d"),
    ("sh_rest", None, "give sh_dc and sh_rest, or colors"),
    ("colors", torch.zeros(3, 3), "give sh_dc and sh_rest, or colors"),
    ("cov3d", torch.zeros(3, 6), "give scales and rotations, or cov3d"),
    ("opacities", None, "opacities must be a tensor, got None"),
    ("sh_degree", -1, "sh_degree must be 0 to 3, got -1"),
    ("image_width", 0, "image size 0x7 is out of range"),
    ("image_height", -1, "image size 18x-1 is out of range"),
    ("viewmatrix", torch.eye(3), r"view must be \(4, 4\), got \(3, 3\)"),
    ("projmatrix", torch.eye(4).bfloat16(), "projection must be float32 or float64, got torch.bfloat16"),
    ("viewmatrix", None, "view must be a tensor, got None"),
    ("campos", torch.zeros(3, dtype=torch.int64), "center must be float32 or float64, got torch.int64"),
    ("bg", torch.zeros(1), r"background must be \(3,\), got \(1,\)"),
    ("bg", torch.zeros(3).half(), "background must be float32 or float64, got torch.float16"),
    ("tanfovx", -1.0, "tan_x must be the tangent of half an angle of view, got -1"),
    ("tanfovy", float("nan"), "tan_y must be the tangent of half an angle of view, got nan"),
    ("tanfovx", float("inf"), "tan_x must be the tangent"),
    ("scale_modifier", float("nan"), "scale_modifier must be finite, got nan"),
    *(("shs", shs, r"shs must be \(N, K, 3\), got ") for shs in (torch.zeros(()), torch.zeros(3), torch.zeros(3, 3))),
    *(
        (name, other(torch.zeros(3, 3)), f"^{name.replace('shs', 'sh')} must be a tensor, got (numpy.ndarray|list)")
        for name in (*scene()[0], "viewmatrix", "bg", "means3D", "means2D", "shs")
        for other in (torch.Tensor.numpy, torch.Tensor.tolist)
    ),
]


@pytest.mark.parametrize(("name", "value", "message"), WRONG)
def test_wrong_inputs_and_settings_are_named(name, value, message):
    splats, camera = scene()
    with pytest.raises((ValueError, TypeError, RuntimeError), match=message):
        if name in ("shs", "means3D", "means2D"):
            call(splats, camera, **{name: value})
        elif name in camera._fields:
            render(splats, camera._replace(**{name: value}), raw=False)
        else:
            render(splats | {name: value}, camera, torch.zeros(3, 3), raw=False)
    if name == "scales" and "activated" in message:
        with pytest.raises(ValueError, match="logarithms"):
            render(few(dtype=torch.float32)[0] | {name: value}, camera, torch.zeros(3, 3))


def test_torch_compile_gives_the_same_gradients(recwarn):
    splats, camera = scene()

    def loss(**inputs: torch.Tensor) -> torch.Tensor:
        return (call(inputs, camera, means2D=torch.zeros_like(inputs["means"]))[0] ** 2).sum()

    expected, compiled = leaves(splats), leaves(splats)
    loss(**expected).backward()
    torch._dynamo.reset()
    torch.compile(loss, backend="aot_eager", fullgraph=True)(**compiled).backward()
    assert not any("Dynamo" in str(warning.message) for warning in recwarn)
    for name, values in expected.items():
        assert torch.equal(compiled[name].grad, values.grad), name
