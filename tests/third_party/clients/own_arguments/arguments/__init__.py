"""The client's own options, which hide the project's `arguments`."""


class GroupParams:
    """Plain attributes."""


def _group(**values):
    group = GroupParams()
    for name, value in values.items():
        setattr(group, name, value)
    return group


def model_options(source, model):
    """The ten options of a model."""
    return _group(
        sh_degree=3, source_path=source, model_path=model, images="images", depths="", resolution=-1,
        white_background=False, train_test_exp=False, data_device="cuda", eval=True,
    )  # fmt: skip


def optimization_options():
    """The options of an optimisation that changes colours alone."""
    return _group(
        iterations=20, position_lr_init=0.0, position_lr_final=0.0, position_lr_delay_mult=0.01,
        position_lr_max_steps=30_000, feature_lr=0.01, opacity_lr=0.0, scaling_lr=0.0, rotation_lr=0.0,
        exposure_lr_init=0.01, exposure_lr_final=0.001, exposure_lr_delay_steps=0, exposure_lr_delay_mult=0.0,
        percent_dense=0.01, lambda_dssim=0.2, style_weight=2.0,
    )  # fmt: skip


def pipeline_options():
    """The options of the renderer."""
    return _group(convert_SHs_python=False, compute_cov3D_python=False, debug=False, antialiasing=False)
