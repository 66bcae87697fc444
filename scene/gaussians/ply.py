"""PLY files of trained models, with the columns of the reference in its order, as other tools read them."""

import math
import os
import sys
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence

import numpy as np
import torch
from plyfile import PlyParseError
from torch import Tensor

from groundwork.files.ply_header import read_elements
from groundwork.ranks.rows import WHOLE, Shards
from scene.gaussians.attributes import IN_CHECKPOINT, Rows, attributes
from scene.gaussians.finite import with_scales
from scene.gaussians.foreign import apply_foreign_filter
from utils.system_utils import UserError, atomic_write, writes_files

FLAT = "flat Gaussians of two scales (2DGS), which this rasterizer cannot draw; give a 3DGS model"
MOST_BANDS = 3  # the highest SH degree of a model; a file may have a higher one
_NORMALS = ["nx", "ny", "nz"]  # zeros after the positions, as in the reference's files


def write_ply(
    path: str | os.PathLike,
    rows: Rows,
    sh_degree: int,
    comments: Sequence[str] = (),
    shards: Shards = WHOLE,
) -> None:
    """Write a binary little-endian PLY, float32, SH bands channel by channel; the whole file or none.

    comments: of the header. shards: the place of the rows among those that together make the file. Every rank must call
    it; the first writes.
    """
    if shards is WHOLE and not writes_files():
        return
    count = len(rows["xyz"])
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {comment}" for comment in comments]
    header += [f"element vertex {shards.total(count)}"]
    names = column_names(sh_degree, rows["scaling"].shape[1], _has_further(rows))
    header += [f"property float {name}" for name in names]
    pieces = shards.pieces(count, lambda part: _make_table(rows, sh_degree, part))
    if not writes_files():
        return deque(pieces, maxlen=0).clear()
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode("ascii"))
        for piece in pieces:
            # Not tofile, which loses the last bytes on a full disk without an error.
            file.write(piece.cpu().numpy().astype("<f4", copy=False))


def _make_table(rows: Rows, sh_degree: int, part: slice) -> Tensor:
    """Some Gaussians (n, columns) as a PLY has them, float32."""
    parts = [rows[name][part] for name in attributes(sh_degree, _has_further(rows))]
    parts.insert(1, torch.zeros_like(parts[0]))
    columns = [(values.transpose(1, 2) if values.dim() == 3 else values).flatten(1) for values in parts]
    return torch.cat(columns, dim=1).float()


def _has_further(rows: Rows) -> bool:
    return len(rows) > len(IN_CHECKPOINT)


def column_names(sh_degree: int, scales: int = 3, further: bool = True) -> list[str]:
    """The properties of a Gaussian, in the order of the file. scales: 2 for the flat ones of clients' own models."""
    parts = [attribute.columns for attribute in attributes(sh_degree, further).values()]
    names = [name for columns in (parts[0], _NORMALS, *parts[1:]) for name in columns]
    return [name for name in names if not name.startswith("scale_") or int(name.removeprefix("scale_")) < scales]


def row_bytes(sh_degree: int) -> int:
    """Bytes of one Gaussian."""
    return 4 * len(column_names(sh_degree))


def frame_comments(world_offset: Sequence[float], enlargement: float) -> list[str]:
    """The comments that keep the world coordinates (3,) of a PLY's origin, unless zero, and an enlargement but 1."""
    kept = [f"world_offset {' '.join(map(repr, world_offset))}"] if any(world_offset) else []
    return kept + ([f"enlargement {enlargement!r}"] if enlargement != 1 else [])


def _find_degree(names: Iterable[str]) -> tuple[int, list[str]]:
    """The least SH degree of so many f_rest, and those of that degree that are missing."""
    rest = {name for name in names if name.startswith("f_rest_")}
    degree = math.ceil((len(rest) / 3 + 1) ** 0.5) - 1
    return degree, [name for i in range(3 * ((degree + 1) ** 2 - 1)) if (name := f"f_rest_{i}") not in rest]


@np.errstate(over="ignore")  # doubles that float32 cannot hold become Inf
def read_ply(path: str | os.PathLike, sh_degree: int | None, flat: bool = False, further: bool = True) -> Rows:
    """Read a Gaussian PLY of any tool: any order of properties, scalar type and encoding.

    flat: take Gaussians of two scales, too, for models that draw them by other code. further: read attributes beyond
    the paper's six, too.

    SH bands that the file lacks are zero: the last save of a training leaves out zero bands. Bands above degree 3 are
    left out, with a warning. Scales of 0 become tiny (`with_scales`). A 3D filter of other programs is applied, and
    unused columns are reported (`apply_foreign_filter`). Names may begin with scalar_, as CloudCompare writes them.
    sh_degree: None: the file's, up to 3. UserError when the file is missing or unreadable, lacks properties (the
    message names them), or has a higher degree.
    """
    vertices = _rename_fields(read_vertices(path))
    present = {name for name in vertices.dtype.names or () if not vertices.dtype[name].hasobject}  # no list
    degree, lacking = _find_degree(present)
    sh_degree = min(degree, MOST_BANDS) if sh_degree is None else sh_degree
    table = attributes(min(degree, sh_degree), further)
    parts = {name: attribute.columns for name, attribute in table.items()}
    missing = [name for part, columns in parts.items() if part != "f_rest" for name in columns if name not in present]
    if flat and missing == ["scale_2"]:
        parts["scaling"] = parts["scaling"][:2]
    elif missing:
        raise UserError(_explain_no_model(path, missing, present))
    every = 3 * ((degree + 1) ** 2 - 1)
    if lacking:
        found = f"{every - len(lacking)} of {every}, without {lacking[0]}"
        raise UserError(f"the SH coefficients f_rest of {path} are incomplete: {found}; export the model again")
    if degree > sh_degree:
        raise UserError(
            f"{path} has {every} f_rest properties, those of SH degree {degree}, but SH degree {sh_degree} needs "
            f"{len(parts['f_rest'])}; give the --sh_degree of the file"
        )
    rows = {}
    for name, attribute in table.items():
        if len(attribute.shape) == 2:  # a file has the bands of one channel after those of another
            bands, channels = attribute.shape
            parts[name] = [parts[name][channel * bands + band] for band in range(bands) for channel in range(channels)]
    for (name, attribute), values in zip(table.items(), _read_columns(vertices, list(parts.values())), strict=True):
        rows[name] = values.reshape(len(vertices), *attribute.shape) if len(attribute.shape) == 2 else values
    rows["scaling"] = with_scales(rows["scaling"])
    rows = apply_foreign_filter(path, rows, vertices, {name for columns in parts.values() for name in columns})
    absent = attributes(sh_degree)["f_rest"].shape[0] - rows["f_rest"].shape[1]
    if absent:
        rows["f_rest"] = torch.nn.functional.pad(rows["f_rest"], (0, 0, 0, absent))
    return rows


def _rename_fields(vertices: np.ndarray) -> np.ndarray:
    """The vertices without CloudCompare's prefix of names, and without the SH bands above a model's highest degree."""
    from numpy.lib.recfunctions import rename_fields, repack_fields  # they take a tenth of a second to import

    names = list(vertices.dtype.names or ())
    if "scalar_f_dc_0" in names:
        vertices = rename_fields(vertices, {name: name.removeprefix("scalar_") for name in names})
        names = list(vertices.dtype.names)
    degree, lacking = _find_degree(names)
    if lacking or degree <= MOST_BANDS:
        return vertices  # a caller names what is lacking
    print(
        f"warning: SH bands of degree {degree} are left out; models have at most degree {MOST_BANDS}", file=sys.stderr
    )
    each, kept = (degree + 1) ** 2 - 1, (MOST_BANDS + 1) ** 2 - 1
    rest = [f"f_rest_{channel * each + index}" for channel in range(3) for index in range(kept)]
    others = [name for name in names if not name.startswith("f_rest_")]
    cut = repack_fields(vertices[others + rest])
    return rename_fields(cut, {name: f"f_rest_{index}" for index, name in enumerate(rest)})


def _explain_no_model(path: str | os.PathLike, missing: Sequence[str], present: Collection[str]) -> str:
    """Say why a PLY is no Gaussian model, with a remedy. missing, present: names of its properties."""
    if list(missing) == ["scale_2"]:
        return f"{path} has {FLAT}"
    if "packed_position" in present:
        return f"{path} is a compressed PLY; unpack it with export.py --ply {path} --to FILE.ply, and give FILE.ply"
    remedy = "give a trained model"
    if {"red", "green", "blue"} <= set(present) and all(name.startswith("f_dc") for name in missing):
        return (
            f"{path} has the colours of its Gaussians as red, green, blue instead of {', '.join(missing)}; export the "
            "model again with its SH coefficients"
        )
    if {"x", "y", "z"} <= set(present) and not any(name.startswith(("f_dc", "opacity", "scale")) for name in present):
        remedy += ", or start a training from this point cloud with train.py --init_pcd_path"
    return f"{path} is not a Gaussian model: it lacks the properties {', '.join(missing)}; {remedy}"


def read_vertices(path: str | os.PathLike) -> np.ndarray:
    """The structured array of the element `vertex`."""
    if not os.path.isfile(path):
        raise UserError(f"no file {path}; give the point_cloud.ply of a trained model")
    try:
        return read_elements(path)["vertex"].data
    except (PlyParseError, ValueError, OverflowError) as error:
        raise UserError(f"{path} is not a complete PLY file ({error}); save or download it again") from error
    except KeyError as error:
        raise UserError(
            f"{path} has no element 'vertex', so it is not a Gaussian model; give a trained model"
        ) from error


def _read_columns(vertices: np.ndarray, parts: list[list[str]]) -> Iterator[Tensor]:
    """(N, len(part)) float32 for each list of names."""
    kinds = {vertices.dtype[name] for name in vertices.dtype.names}
    if kinds == {np.dtype("<f4")} and vertices.dtype.itemsize == 4 * len(vertices.dtype.names):
        # One table of floats: copying its columns is many times faster than copying field by field.
        table = np.asarray(vertices).view("<f4").reshape(len(vertices), len(vertices.dtype.names))
        position = {name: i for i, name in enumerate(vertices.dtype.names)}
        for part in parts:
            chosen = torch.tensor([position[name] for name in part], dtype=torch.long)
            yield torch.from_numpy(table).index_select(1, chosen)
        return
    for part in parts:
        matrix = np.empty((len(vertices), len(part)), dtype=np.float32)
        for i, name in enumerate(part):
            matrix[:, i] = vertices[name]
        yield torch.from_numpy(matrix)
