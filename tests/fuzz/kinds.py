"""The kinds of cases, by name."""

from fuzz import files, models, options, pickles, pictures, rasterizer

KINDS = {
    "colmap": files.Colmap,
    "transforms": files.Transforms,
    "cloud": files.Cloud,
    "ply": models.Ply,
    "splats": models.Splats,
    "checkpoint": models.Checkpoint,
    "pickle": pickles.Mutated,
    "crafted": pickles.Crafted,
    "picture": pictures.Picture,
    "options": options.Options,
    "rasterizer": rasterizer.Rasterizer,
}
