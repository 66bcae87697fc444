"""Cameras made with the arguments of either release of the reference, and what other code does with a camera."""

import copy
import math
import pickle
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gaussians import model, pipeline
from PIL import Image
from scipy.spatial.transform import Rotation

from gaussian_renderer import render
from scene.cameras import Camera
from scene.images.masks import Mask
from scene.images.store import ImageStore
from scene.readers.info import CameraInfo
from utils.camera_utils import loadCam
from utils.system_utils import UserError

WIDTH, HEIGHT = 40, 24
R = Rotation.from_euler("xyz", [20, -35, 60], degrees=True).as_matrix()
T = np.array([0.3, -0.2, 4.0])
FOV_X, FOV_Y = 0.8, 0.5
MATRICES = ("world_view_transform", "projection_matrix", "full_proj_transform", "camera_center")
RNG = np.random.default_rng(0)


def _photo(channels: int = 3) -> Image.Image:
    return Image.fromarray(RNG.integers(0, 256, (HEIGHT, WIDTH, channels), dtype=np.uint8))


def _newer(image: Image.Image | None = None, **changes) -> Camera:
    """A camera of the 2024 release, by keyword as that release's code makes it."""
    values = {
        "resolution": (WIDTH, HEIGHT), "colmap_id": 7, "R": R, "T": T, "FoVx": FOV_X, "FoVy": FOV_Y,
        "depth_params": None, "image": _photo() if image is None else image, "invdepthmap": None,
        "image_name": "a.png", "uid": 3,
    }  # fmt: skip
    return Camera(**{**values, **changes})


def _older(image: torch.Tensor, alpha: torch.Tensor | None = None, **changes) -> Camera:
    values = {"colmap_id": 7, "R": R, "T": T, "FoVx": FOV_X, "FoVy": FOV_Y, "image_name": "a", "uid": 3}
    return Camera(image=image, gt_alpha_mask=alpha, **{**values, **changes})


def _of_file(path: Path, size: tuple[int, int] = (WIDTH, HEIGHT), **changes) -> Camera:
    focal = {"fx": 50.0, "fy": 50.0, "cx": WIDTH / 2, "cy": HEIGHT / 2, "width": WIDTH, "height": HEIGHT}
    info = CameraInfo(uid=1, R=R, T=T, **focal, image_path=path, image_name=path.name, file_size=size, **changes)
    return Camera(info, size, 0)


@pytest.mark.parametrize(("trans", "scale"), [(np.zeros(3), 1.0), (np.array([0.5, -1.0, 2.0]), 1.5)])
@pytest.mark.parametrize("newer", [True, False])
def test_both_forms_have_the_references_attributes(newer, trans, scale):
    moved = {"trans": trans, "scale": scale}
    camera = _newer(**moved) if newer else _older(torch.zeros(3, HEIGHT, WIDTH), **moved)
    of_record = CameraInfo(7, R, T, FOV_Y, FOV_X, width=WIDTH, height=HEIGHT, image=_photo())
    for name in MATRICES:
        assert torch.equal(getattr(camera, name), getattr(Camera(of_record, (WIDTH, HEIGHT), 0, **moved), name))
    assert (camera.uid, camera.colmap_id, camera.image_name) == (3, 7, "a.png" if newer else "a")
    assert camera.R is R and camera.T is T and (camera.FoVx, camera.FoVy) == (FOV_X, FOV_Y)
    assert (camera.image_width, camera.image_height, camera.znear, camera.zfar) == (WIDTH, HEIGHT, 0.01, 100.0)
    assert (camera.trans == trans).all() and camera.scale == scale and camera.data_device == camera.device
    assert camera.fx == pytest.approx(WIDTH / 2 / math.tan(FOV_X / 2)) and (camera.cx, camera.cy) == (20, 12)
    assert camera.original_image.shape == (3, HEIGHT, WIDTH) and camera.alpha_mask.shape == (1, HEIGHT, WIDTH)
    assert camera.alpha_mask.all() and camera.counted_pixels is None and camera.columns is None
    assert camera.invdepthmap is None and camera.depth_mask is None and camera.depth_reliable is False
    assert isinstance(camera, torch.nn.Module) and not list(camera.parameters())


def _by_record(**changes) -> Camera:
    values = {"uid": 3, "R": R, "T": T, "FovY": FOV_Y, "FovX": FOV_X, "width": WIDTH, "height": HEIGHT}
    info = CameraInfo(**{**values, **changes}, image_name="a", image=_photo())
    return loadCam(SimpleNamespace(resolution=1, data_device="cuda"), 3, info, 1.0)


MAKERS = {"newer": _newer, "older": partial(_older, torch.zeros(3, HEIGHT, WIDTH)), "record": _by_record}


@pytest.mark.parametrize("scale", [0.25, 1e-5])
@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_a_scale_of_the_pose_is_divided_out(make, scale):
    plain, scaled = make(), make(R=scale * R, T=scale * T)
    for name in MATRICES:
        torch.testing.assert_close(getattr(scaled, name), getattr(plain, name), rtol=2e-7, atol=2e-7)
    same = np.testing.assert_array_equal if scale == 0.25 else partial(np.testing.assert_allclose, rtol=1e-14)
    same(scaled.R, R)
    same(scaled.T, T)


@pytest.mark.parametrize("rounded", [R.astype(np.float32), R.round(4), R * 1.00005, [row.tolist() for row in R]])
@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_a_rounded_rotation_is_taken_as_it_is(make, rounded):
    assert make(R=rounded).R is rounded


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (R * [1, 1, -1], "mirrored"),
        (-2 * R, "mirrored"),
        (R * [1, 1, 1.01], "scales by 1 to 1.01;"),
        (R + [[0, 0.01, 0], [0, 0, 0], [0, 0, 0]], "scales by 0.99"),
        (R * 0, "scales by 0 to 0;"),
        (R * 1e7, "scales by 1e[+]07"),
        (R * np.nan, "not finite"),
    ],
)
@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_a_pose_without_a_rotation_is_refused_by_name(make, matrix, said):
    with pytest.raises(UserError, match=f"pose of a(.png)? .*{said}") as error:
        make(R=matrix)
    assert "\n" not in str(error.value) and "; " in str(error.value)


def test_arguments_by_position():
    photo = _photo()
    common = (7, R, T, FOV_X, FOV_Y)
    moved = (np.array([1.0, 0.0, 0.0]), 2.0, "cpu")
    depth = RNG.random((HEIGHT, WIDTH))
    newer = Camera((WIDTH, HEIGHT), *common, None, photo, depth, "a.png", 3, *moved, True, True, True)
    image = torch.from_numpy(np.asarray(photo).transpose(2, 0, 1) / 255.0).float()
    older = Camera(*common, image, torch.ones(1, HEIGHT, WIDTH), "a.png", 3, *moved)
    for name in MATRICES:
        assert torch.equal(getattr(newer, name), getattr(older, name))
    assert torch.equal(newer.original_image, older.original_image)
    assert (newer.uid, older.uid, newer.scale, older.scale) == (3, 3, 2.0, 2.0)
    assert newer.columns == slice(WIDTH // 2, WIDTH) and newer.depth_reliable
    for size in ([WIDTH, HEIGHT], np.array([WIDTH, HEIGHT]), torch.Size([WIDTH, HEIGHT])):
        assert Camera(size, *common, None, photo, None, "a.png", 3).image_width == WIDTH


KINDS = {
    "rgb": lambda: _photo(),
    "rgba": lambda: _photo(4),
    "opaque": lambda: _photo().convert("RGBA"),
    "16-bit": lambda: Image.fromarray(RNG.integers(0, 65536, (HEIGHT, WIDTH), dtype=np.uint16)),
}


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (17, 11)])
@pytest.mark.parametrize("kind", KINDS)
def test_a_pil_image_is_seen_as_its_file_is(tmp_path, kind, size):
    path = tmp_path / "a.png"
    KINDS[kind]().save(path)
    of_file = _of_file(path, size)
    with Image.open(path) as image:
        given = _newer(image, resolution=size)
    background = torch.tensor([0.2, 0.5, 1.0])
    target = given.target(background)
    assert target.dtype == of_file.target(background).dtype and target.shape == (3, size[1], size[0])
    assert torch.equal(target, of_file.target(background))
    assert torch.equal(given.original_image, of_file.original_image)
    assert torch.equal(given.alpha_mask, of_file.alpha_mask) and (given.alpha_mask == 1).all() == (kind != "rgba")
    assert given.undecoded == [] and of_file.undecoded == [(path, size)]


def test_a_float_image_keeps_its_values():
    image = torch.from_numpy(RNG.uniform(-0.5, 1.5, (3, HEIGHT, WIDTH))).float()
    clamped = image.clamp(0, 1)
    camera = _older(image)
    assert torch.equal(camera.original_image, clamped) and camera.original_image.dtype == torch.float32
    assert torch.equal(camera.target(torch.ones(3)), clamped) and camera.undecoded == []
    alpha = torch.from_numpy(RNG.random((1, HEIGHT, WIDTH))).float()
    camera = _older(image, alpha)
    assert torch.equal(camera.original_image, clamped * alpha) and torch.equal(camera.alpha_mask, alpha)
    background = torch.tensor([0.2, 0.5, 1.0])
    wanted = clamped * alpha + (1 - alpha) * background[:, None, None]
    torch.testing.assert_close(camera.target(background), wanted, rtol=0, atol=1e-6)
    assert camera.ground_truth(background)[1] is None
    assert _older(image.double()).original_image.dtype == torch.float64
    assert _older(image.double()).target(background).dtype == torch.float32  # as the loss wants it


ASSIGNED = {
    "uid": 9, "colmap_id": 8, "R": np.eye(3), "T": np.ones(3), "FoVx": 1.1, "FoVy": 1.2, "image_name": "b",
    "data_device": "somewhere", "original_image": torch.rand(3, 2, 2), "alpha_mask": None, "image_width": 5,
    "image_height": 6, "invdepthmap": torch.rand(1, 2, 2), "depth_mask": torch.rand(1, 2, 2), "depth_reliable": True,
    "zfar": 7.0, "znear": 0.5, "trans": np.ones(3), "scale": 4.0, "world_view_transform": torch.rand(4, 4),
    "projection_matrix": torch.rand(4, 4), "full_proj_transform": torch.rand(4, 4), "camera_center": torch.rand(3),
    "features_of_their_own": torch.rand(2),
}  # fmt: skip


@pytest.mark.parametrize("name", ASSIGNED)
def test_what_is_assigned_is_read_back(name):
    camera = _newer()
    before = camera.world_view_transform.clone()
    setattr(camera, name, ASSIGNED[name])
    assert getattr(camera, name) is ASSIGNED[name]
    if name != "world_view_transform":
        assert torch.equal(camera.world_view_transform, before)  # nothing is computed again
    copied, loaded = copy.deepcopy(camera), pickle.loads(pickle.dumps(camera))
    for other in (copied, loaded):
        np.testing.assert_array_equal(getattr(other, name), ASSIGNED[name])


def test_an_assigned_image_is_the_target():
    background = torch.tensor([0.2, 0.5, 1.0])
    image, alpha = torch.rand(3, HEIGHT, WIDTH), torch.rand(1, HEIGHT, WIDTH)
    camera = _newer()
    camera.original_image = image
    assert torch.equal(camera.target(background), image)
    camera.alpha_mask = alpha
    wanted = image * alpha + (1 - alpha) * background[:, None, None]
    torch.testing.assert_close(camera.ground_truth(background)[0], wanted, rtol=0, atol=1e-6)


def test_the_renderer_uses_what_is_assigned():
    gaussians, black = model(30), torch.zeros(3)
    here, there = _newer(), _newer(T=T + 0.3)
    wanted = render(there, gaussians, pipeline(), black)["render"]
    assert not torch.equal(render(here, gaussians, pipeline(), black)["render"], wanted)
    for name in MATRICES:
        setattr(here, name, getattr(there, name))
    assert torch.equal(render(here, gaussians, pipeline(), black)["render"], wanted)
    here.image_width, here.image_height = 16, 8
    assert render(here, gaussians, pipeline(), black)["render"].shape == (3, 8, 16)
    assert here.original_image.shape == (3, HEIGHT, WIDTH)  # the photo's size stays


@pytest.fixture
def used(tmp_path: Path) -> Camera:
    """A camera of a large photo with a mask, all pictures of which are decoded, in a store with others."""
    Image.fromarray(RNG.integers(0, 256, (600, 800, 4), dtype=np.uint8)).save(tmp_path / "a.png")
    Image.fromarray(RNG.integers(0, 2, (600, 800), dtype=np.uint8) * np.uint8(255)).save(tmp_path / "mask.png")
    camera = _of_file(tmp_path / "a.png", (800, 600), mask=Mask(tmp_path / "mask.png"))
    camera.images = ImageStore(0)
    for picture in camera.undecoded:
        camera.images.get(*picture)
    assert camera.original_image.shape == (3, 600, 800) and camera.alpha_mask.shape == (1, 600, 800)
    return camera


def test_a_copy_shares_the_photos_and_nothing_else(used, monkeypatch):
    in_memory, black = _newer(), torch.zeros(3)
    assert copy.deepcopy(in_memory).target(black).data_ptr() == in_memory.target(black).data_ptr()
    used.note = [1]
    twin = copy.deepcopy(used)
    assert twin.images is used.images and twin.undecoded == used.undecoded and type(twin) is Camera
    monkeypatch.setattr("scene.images.store.decode", lambda *_: pytest.fail("decoded again"))
    assert torch.equal(twin.original_image, used.original_image)
    assert torch.equal(twin.counted_pixels, used.counted_pixels)
    assert twin.original_image.data_ptr() != used.original_image.data_ptr()
    for name in ("R", "T", *MATRICES):
        getattr(twin, name)[:] = 7.0
        assert not (np.asarray(getattr(used, name)) == 7.0).all()
    twin.note.append(2)
    twin.columns, twin.original_image = slice(0, 3), torch.zeros(3, 1, 1)
    assert used.columns is None and used.original_image.shape == (3, 600, 800) and used.note == [1]


def test_a_pickle_leaves_the_photos_out(used):
    content = pickle.dumps(used)
    assert len(content) < 8192 and b"scene.cameras" in content  # where other versions look for the class, too
    loaded = pickle.loads(content)
    assert loaded.images is not used.images and len(loaded.images) == 0
    for name in ("original_image", "counted_pixels", "full_proj_transform"):
        assert torch.equal(getattr(loaded, name), getattr(used, name))


@pytest.mark.parametrize("kind", ["rgb", "rgba", "float"])
def test_a_change_in_place_stays_in_copies_and_in_the_target(kind, tmp_path):
    background = torch.tensor([0.2, 0.5, 1.0])
    photo = _photo(4 if kind == "rgba" else 3)
    photo.save(tmp_path / "a.png")
    image, alpha = torch.rand(3, HEIGHT, WIDTH), torch.rand(1, HEIGHT, WIDTH)
    camera = _older(image, alpha) if kind == "float" else _of_file(tmp_path / "a.png")
    wanted, unchanged = camera.target(background).clone(), camera.original_image.clone()
    wanted = wanted if wanted.is_floating_point() else wanted.float() / 255
    assert copy.deepcopy(camera)._made == {}  # unchanged pixels are not copied
    camera.original_image[:, :10] = 0
    assert not camera.original_image[:, :10].any()
    over = (1 - camera.alpha_mask[:, :10]) * background[:, None, None]
    wanted[:, :10] = over
    for other in (camera, copy.copy(camera), copy.deepcopy(camera), pickle.loads(pickle.dumps(camera))):
        assert torch.equal(other.original_image, camera.original_image)
        torch.testing.assert_close(other.target(background), wanted, rtol=0, atol=1e-6)
        torch.testing.assert_close(other.ground_truth(background)[0], wanted, rtol=0, atol=1e-6)
    own = copy.deepcopy(camera)
    own.original_image[:, 10:] = 1
    assert torch.equal(camera.original_image[:, 10:], unchanged[:, 10:])
    del camera.original_image
    assert torch.equal(camera.original_image, unchanged) and not own.original_image[:, :10].any()


@pytest.mark.parametrize("name", ["original_image", "alpha_mask", "invdepthmap", "depth_mask"])
def test_a_parameter_may_be_assigned_and_anything_deleted(name):
    camera = _newer(invdepthmap=np.ones((HEIGHT, WIDTH)))
    photos = getattr(camera, name).clone()
    parameter = torch.nn.Parameter(torch.full_like(photos, 0.25))
    setattr(camera, name, parameter)
    assert getattr(camera, name) is parameter and [n for n, _ in camera.named_parameters()] == [name]
    for other in (copy.deepcopy(camera), pickle.loads(pickle.dumps(camera))):
        assert getattr(other, name) is dict(other.named_parameters())[name]
    if name == "original_image":
        camera.target(torch.zeros(3)).sum().backward()
        assert (parameter.grad == 1).all()
    setattr(camera, name, parameter.detach())
    assert not list(camera.parameters())
    setattr(camera, name, parameter)
    delattr(camera, name)
    assert torch.equal(getattr(camera, name), photos) and not list(camera.parameters())


def test_images_for_other_code_lie_on_the_data_device(monkeypatch):
    computes = torch.device("meta")  # stands for a GPU
    monkeypatch.setattr("scene.view.compute_device", lambda: computes)
    camera = _newer(_photo(4), invdepthmap=np.ones((HEIGHT, WIDTH)), data_device="cpu")
    assert camera.data_device == torch.device("cpu") and camera.camera_center.device == computes
    for name in ("original_image", "alpha_mask", "invdepthmap", "depth_mask"):
        assert getattr(camera, name).device.type == "cpu" and getattr(camera, name).shape[1:] == (HEIGHT, WIDTH)
    assert camera.target_inverse_depth.device == computes
    camera.original_image[:, 0] = 0
    assert camera.target(torch.zeros(3)).device == computes
    camera.invdepthmap = torch.zeros(1, 2, 2)
    assert camera.target_inverse_depth.device == computes and camera.target_inverse_depth.shape == (1, 2, 2)
