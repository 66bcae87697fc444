"""The parser of the remote viewer's requests: what it takes, and that nothing else gets past it."""

import json
import math
import random

import pytest
import torch
from gaussians import model, pipeline
from viewer_client import FIELDS, as_bytes, request

from gaussian_renderer import render
from gaussian_renderer.free_view import free_view
from gaussian_renderer.network_message import BadMessage, decode, parse
from splatting.remote_viewer import frame_bytes

CAMERA = free_view(24, 16, 0.8, (0.1, -0.2, -3.0), (0.9, 0.3, -0.2, math.sqrt(0.06)), "cpu")
VALID = request(CAMERA)
NAN, INF = float("nan"), float("inf")


def test_a_request_has_the_camera_that_was_sent():
    parsed = parse(decode(json.dumps(request(CAMERA, train=1, scaling_modifier=0.5, unknown="x")).encode()))
    camera = parsed.camera(torch.device("cpu"))
    for name in ("world_view_transform", "full_proj_transform", "camera_center"):
        assert torch.equal(getattr(camera, name), getattr(CAMERA, name)), name
    for name in ("image_width", "image_height", "FoVx", "FoVy", "znear", "zfar"):
        assert getattr(camera, name) == getattr(CAMERA, name), name
    assert (parsed.train, parsed.keep_alive, parsed.scaling_modifier) == (True, False, 0.5)


def _of_view(factors: list[float]) -> dict[str, list[float]]:
    """The message's view matrix with its first three columns times factors: all three are a scale."""
    columns = [*factors, 1.0]
    return {"view_matrix": [value * columns[place % 4] for place, value in enumerate(VALID["view_matrix"])]}


def test_a_scale_of_the_view_is_divided_out():
    parsed, scaled = (parse(VALID | changes).camera("cpu") for changes in ({}, _of_view([4.0, 4.0, 4.0])))
    assert torch.equal(parsed.world_view_transform, scaled.world_view_transform)
    assert torch.equal(parsed.camera_center, scaled.camera_center)


@pytest.mark.parametrize("size", [(0, 16), (24, 0), (0, 0), (0, 10**6)])
def test_without_a_size_no_other_field_is_read(size):
    assert parse({"resolution_x": size[0], "resolution_y": size[1], "train": "no"}) is None


@pytest.mark.parametrize("name", FIELDS)
def test_every_field_is_needed_and_has_its_type(name):
    without = {key: value for key, value in VALID.items() if key != name}
    with pytest.raises(BadMessage, match=f"no {name}"):
        parse(without)
    for value in (None, "1", [], {}, [VALID[name]], 1.0 if isinstance(VALID[name], int) else "x", NAN):
        with pytest.raises(BadMessage, match=name):
            parse(VALID | {name: value})


@pytest.mark.parametrize(
    "changes",
    [
        {"resolution_x": 8193},
        {"resolution_x": 8192, "resolution_y": 8192},
        {"resolution_x": -24},
        {"fov_y": math.pi},
        {"z_far": 10**400},
        {"scaling_modifier": 10.5},
        {"train": 2},
        {"view_matrix": [NAN] * 16},
        {"view_matrix": [*VALID["view_matrix"][:15], 1e300]},
        _of_view([1.0, -1.0, 1.0]),
        _of_view([1.0, 1.01, 1.0]),
        {"view_matrix": VALID["view_matrix"][:15]},
    ],
    ids=lambda changes: " ".join(changes),
)
def test_what_is_out_of_range_is_refused(changes):
    with pytest.raises(BadMessage):
        parse(decode(json.dumps(VALID | changes).encode()))


@pytest.mark.parametrize(
    "text", [b"", b"\xff\xfe", b"{", b"[]", b"3", b"null", b"[" * 60_000, b'{"a":' * 9_000, b"9" * 60_000, b'{"a":1}x']
)
def test_what_is_no_object_is_refused(text):
    with pytest.raises(BadMessage, match="JSON"):
        decode(text)


def mutated(rng: random.Random) -> bytes:
    """A valid request with one to three changes of a value, of a byte, or of its length."""
    message = json.loads(json.dumps(VALID))
    numbers = [0, -1, 1, 7, 1e-30, 1e30, -1e30, 3.1415926]
    wild = [*numbers, NAN, INF, 10**30, None, True, "", "a", [], {}, [0] * 16]
    for _ in range(rng.randint(1, 3)):
        name = rng.choice([*FIELDS, "view_projection_matrix"])  # few changes of a view leave it a rotation
        if "matrix" in name and isinstance(message.get(name), list) and message[name] and rng.random() < 0.8:
            message[name][rng.randrange(len(message[name]))] = rng.choice(numbers if rng.random() < 0.9 else wild)
        elif rng.random() < 0.1:
            message.pop(name, None)
        else:
            message[name] = rng.choice(wild)
    text = bytearray(json.dumps(message).encode())
    if rng.random() < 0.3:
        text[rng.randrange(len(text))] = rng.randrange(256)
    return bytes(text[: rng.randrange(len(text))] if rng.random() < 0.1 else text)


def test_a_thousand_random_messages_are_refused_or_rendered():
    """Whatever the parser takes can be rendered: nothing but BadMessage is ever raised."""
    rng, gaussians, pipe, rendered, refused = random.Random(25), model(40), pipeline(), 0, 0
    black = gaussians.get_xyz.new_zeros(3)
    for _ in range(1000):
        try:
            parsed = parse(decode(mutated(rng)))
        except BadMessage as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 120
            continue
        if parsed is not None:
            assert frame_bytes(parsed, gaussians, pipe, black).nbytes == 3 * parsed.width * parsed.height
            rendered += 1
    assert rendered > 100 and refused > 300


def test_the_switches_count_for_the_frame_alone():
    gaussians, pipe = model(40), pipeline(convert_SHs_python=True, antialiasing=True)
    before, white = dict(vars(pipe)), gaussians.get_xyz.new_ones(3)
    camera = parse(VALID).camera(white.device)
    for shs in (0, 1):
        frame = frame_bytes(parse(request(CAMERA, shs_python=shs, rot_scale_python=1)), gaussians, pipe, white)
        with torch.no_grad():
            options = pipeline(convert_SHs_python=bool(shs), compute_cov3D_python=True, antialiasing=True)
            expected = as_bytes(render(camera, gaussians, options, white)["render"])
        assert bytes(frame) == expected.tobytes() and expected.std() > 10
    assert vars(pipe) == before
