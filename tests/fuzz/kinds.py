"""The kinds of cases, by name."""

from fuzz import files, models, options, pictures, rasterizer

KINDS = {
    "colmap": files.Colmap,
    "transforms": files.Transforms,
    "cloud": files.Cloud,
    "ply": models.Ply,
    "splats": models.Splats,
    "checkpoint": models.Checkpoint,
    "picture": pictures.Picture,
    "options": options.Options,
    "rasterizer": rasterizer.Rasterizer,
}
