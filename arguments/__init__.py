"""Command-line options, and their storage in a model folder."""

from arguments.groups import OPTIONS, ModelParams, OptimizationParams, PipelineParams
from arguments.param_group import GroupParams, OptionParser, ParamGroup
from arguments.stored import (
    VERSION,
    VIEW_OPTIONS,
    add_to_model_json,
    get_combined_args,
    other_scene,
    read_cfg_args,
    read_model_json,
    read_stored_options,
    read_training_options,
    warn_of_background,
    write_cfg_args,
    write_model_json,
)
from arguments.topics import TopicParser

__all__ = [
    "OPTIONS",
    "VERSION",
    "VIEW_OPTIONS",
    "GroupParams",
    "ModelParams",
    "OptimizationParams",
    "OptionParser",
    "ParamGroup",
    "PipelineParams",
    "TopicParser",
    "add_to_model_json",
    "get_combined_args",
    "read_cfg_args",
    "read_model_json",
    "read_stored_options",
    "other_scene",
    "read_training_options",
    "warn_of_background",
    "write_cfg_args",
    "write_model_json",
]
