"""One line on the parts of a file that no reader uses: fields, columns and records of other programs."""

import os
import sys
from collections.abc import Iterable
from functools import cache
from typing import NamedTuple


class Form(NamedTuple):
    """A kind of file: what its parts are called, and the names of parts that change no result."""

    parts: str
    harmless: frozenset[str]


_ABOUT = (  # where a file comes from
    "author comment created creator dataset date description exporter generator id license name scene software source "
    "title version"
)
_TRANSFORMS = (  # what nerfstudio, instant-ngp, Blender's exporters and SDFStudio keep for their own use
    "aabb aabb_scale applied_scale applied_transform auto_scale_poses_override center_method_override "
    "depth_integer_scale depth_unit_scale_factor enable_depth_loading enable_ray_loading far fps frame_count from_na "
    "has_foreground_mask has_mask has_mono_prior has_sparse_sfm_points importance_sampling integer_depth_scale "
    "n_extra_learnable_dims n_frames near num_frames offset orientation_override render_aabb render_aabb_to_local "
    "scale scene_box up worldtogt"
)
_FRAMES = (
    "blur_score cam_id cam_name camera_id camera_label camera_name center_depth colmap_camera_id colmap_id "
    "colmap_im_id colmap_image_id far frame_id image_id image_name index label manual_keyframe near neighbors "
    "original_file_path original_name original_path rotation sharpness timestamp"
)
_METASHAPE = (
    "bands black_level camera_ids covariance data_type frames layer_index location_covariance markers meta orientation "
    "partition photo property reference region rotation_covariance scalebars sensitivity settings shapes vignetting"
)
# The images file has the poses that follow from rigs and frames; depth maps have the parameters.
_COLMAP = "depth_params.json desktop.ini frames.bin frames.txt project.ini rigs.bin rigs.txt Thumbs.db"
_PLY = "nx ny nz red green blue alpha Original_cloud_index"  # colours of band 0, for viewers of points; CloudCompare's
_PLY_ELEMENTS = "face camera extrinsic intrinsic image_size frame disparity version"  # MeshLab's, Apple's SHARP's
# By the name of the kind of file.
FORMS = {
    "transforms": Form("fields", frozenset([*_ABOUT.split(), *_TRANSFORMS.split()])),
    "frames": Form("fields of the frames", frozenset([*_ABOUT.split(), *_FRAMES.split()])),  # of transforms.json
    "ply": Form("columns", frozenset(_PLY.split())),
    "ply elements": Form("elements", frozenset(_PLY_ELEMENTS.split())),
    "spz": Form("records", frozenset({"0xADBE0002"})),  # limits of a viewer's camera
    "metashape": Form("elements", frozenset(_METASHAPE.split())),
    "colmap": Form("files", frozenset(_COLMAP.split())),
}
_TOLD = 3  # names


def note_unread(path: str | os.PathLike, form: str, names: Iterable[str]) -> None:
    """Print a line that names up to three parts of a file that its reader skips, harmless ones left out.

    form: a key of FORMS. names: names of all parts that the reader skips.
    """
    parts, harmless = FORMS[form]
    if left := sorted(set(names) - harmless):
        more = f" and {len(left) - _TOLD} more" if len(left) > _TOLD else ""
        note_once(f"{parts} of {path} that are not used: {', '.join(left[:_TOLD])}{more}")


@cache
def note_once(line: str) -> None:
    """Print a line to stderr, once per process: some commands read a file several times."""
    print(line, file=sys.stderr)
