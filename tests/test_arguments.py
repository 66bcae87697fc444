"""Options, and their storage in a model folder."""

import argparse

import pytest
import torch

import train
from arguments import (
    OPTIONS,
    ModelParams,
    OptimizationParams,
    OptionParser,
    PipelineParams,
    get_combined_args,
    read_cfg_args,
    read_model_json,
    read_stored_options,
    write_cfg_args,
    write_model_json,
)
from arguments.option import MOST_NEEDED, TOPICS
from utils.system_utils import UserError

# fmt: off
MODEL = {
    "sh_degree": 3, "source_path": "", "model_path": "", "images": "images", "depths": "", "resolution": -1,
    "white_background": False, "train_test_exp": False, "data_device": "cuda", "eval": False,
}
PIPELINE = {"convert_SHs_python": False, "compute_cov3D_python": False, "debug": False, "antialiasing": False}
OPTIMISATION = {
    "iterations": 30000, "position_lr_init": 1.6e-4, "position_lr_final": 1.6e-6, "position_lr_delay_mult": 0.01,
    "position_lr_max_steps": 30000, "feature_lr": 0.0025, "opacity_lr": 0.025, "scaling_lr": 0.005,
    "rotation_lr": 0.001, "exposure_lr_init": 0.01, "exposure_lr_final": 0.001, "exposure_lr_delay_steps": 0,
    "exposure_lr_delay_mult": 0.0, "percent_dense": 0.01, "lambda_dssim": 0.2, "densification_interval": 100,
    "opacity_reset_interval": 3000, "densify_from_iter": 500, "densify_until_iter": 15000,
    "densify_grad_threshold": 2e-4, "depth_l1_weight_init": 1.0, "depth_l1_weight_final": 0.01,
    "random_background": False, "optimizer_type": "default",
}
REFERENCE = MODEL | PIPELINE | OPTIMISATION
OURS = {option.name for option in OPTIONS if option.ours}
LAUNCH = (
    "ip port debug_from detect_anomaly test_iterations save_iterations checkpoint_iterations start_checkpoint quiet "
    "disable_viewer no_curve"
)
ABSURD = {
    "sh_degree": "4 -1", "resolution": "0 -2", "images_to_load": "-1", "iterations": "-5 0 2147483648",
    "position_lr_init": "nan", "opacity_lr": "-0.1", "scaling_lr": "inf", "lambda_dssim": "1.5",
    "densification_interval": "0", "densify_grad_threshold": "0", "max_num_splats": "-1", "seed": "-1",
    "holdout": "every9",
    "optimizer_type": "sgd", "strategy": "mine", "absgrad_threshold": "0 nan",
    "projection": "affine", "robust_mask": "0.6 -0.1", "appearance": "exposure", "sky": "blue",
    "opacity_decay": "1.01 0.4", "prune_opacity": "0.6 -0.1", "mcmc_until_iter": "-1",
    "prune_sh": "-0.5 nan",
    "mcmc_growth": "-0.1 1.1", "mcmc_min_opacity": "0 1", "mcmc_noise": "-1 inf 1e300",
    "mcmc_opacity_reg": "-0.01",
    "mcmc_scale_reg": "-0.01", "mcmc_init_opacity": "1", "mcmc_init_scale": "-0.1",
    "time_budget": "-1 inf 1e300", "gpu_memory": "-1 nan 1e300",
    "exposure_lr_init": "-0.1", "exposure_lr_delay_steps": "-1",
    "exposure_lr_delay_mult": "1.5", "depth_l1_weight_final": "-1",
}
# fmt: on


def _parse(*argv: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    groups = ModelParams(parser), PipelineParams(parser), OptimizationParams(parser)
    args = parser.parse_args(argv)
    return argparse.Namespace(**{k: v for group in groups for k, v in vars(group.extract(args)).items()})


def test_defaults_are_the_contracts():
    assert {name: value for name, value in vars(_parse()).items() if name not in OURS} == REFERENCE
    assert all(len(option.help) > 10 and option.origin for option in OPTIONS)


def _help(capsys: pytest.CaptureFixture[str], word: str) -> str:
    with pytest.raises(SystemExit) as exit_info:
        train.main([word])
    assert exit_info.value.code == 0
    return capsys.readouterr().out


def test_train_help_lists_the_contracts_options(capsys):
    text = _help(capsys, "--help-all")
    assert [name for name in (*REFERENCE, *OURS, *LAUNCH.split()) if f"--{name}" not in text] == []
    assert "--strategy {auto,adc,mcmc,budget}" in text


def test_short_help_fits_on_two_screens_and_names_all_topics(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = _help(capsys, "-h")
    assert text == _help(capsys, "--he") and len(text.splitlines()) <= 60
    assert [topic for topic in TOPICS if topic not in text] == []
    assert {option.topic for option in OPTIONS} | {MOST_NEEDED, "viewers"} == {*TOPICS}


@pytest.mark.parametrize(("option", "value"), [(name, v) for name, values in ABSURD.items() for v in values.split()])
def test_absurd_values_name_their_option(option, value):
    with pytest.raises(UserError, match=f"^--{option} "):
        _parse(f"--{option}={value}")


def test_a_typed_zero_is_refused_where_it_would_count_as_not_given(capsys):
    with pytest.raises(SystemExit) as exit_info:
        train.main(["-s", "absent", "--time_budget", "0"])
    assert exit_info.value.code == 2
    assert "argument --time_budget: must be above 0; leave it out for its default" in capsys.readouterr().err
    for name in ("gpu_memory", "max_num_splats", "images_to_load"):  # where it means no limit
        train.parse(["-s", "absent", f"--{name}", "0"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-s", "C:\\scenes\\fox"], "C:\\scenes\\fox is a path of Windows; under WSL, type /mnt/c/scenes/fox"),
        (["-m", "d:/my model"], "d:/my model is a path of Windows; under WSL, type /mnt/d/my model"),
        (["-s", "C:scenesfox"], "under WSL, type /mnt/c/..."),
        (["-x", "1"], "there is no option -x"),
    ],
)
def test_what_a_user_of_windows_types(capsys, words, said):
    with pytest.raises(SystemExit):
        train.main(words)
    assert said in capsys.readouterr().err


def test_a_limit_of_a_gpus_memory_without_a_gpu_is_refused(colmap_scene, tmp_path):
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(UserError, match="--gpu_memory limits the memory of a GPU, and there is none to use"):
        train.main(["-s", str(colmap_scene), "-m", str(tmp_path / "out"), "--gpu_memory", "4"])
    assert not (tmp_path / "out").exists()


# Groups as code for the reference writes them


def test_groups_carry_their_defaults_as_the_references_do():
    parser = argparse.ArgumentParser()
    model, pipeline, optimisation = ModelParams(parser), PipelineParams(parser), OptimizationParams(parser)
    short = {"source_path", "model_path", "images", "depths", "resolution", "white_background"}
    assert (
        vars(model).items() >= {f"_{name}" if name in short else name: value for name, value in MODEL.items()}.items()
    )
    assert vars(pipeline) == PIPELINE | {"projection": "ewa"}
    assert vars(optimisation).items() >= OPTIMISATION.items()
    assert vars(ModelParams(argparse.ArgumentParser(), sentinel=True)) == vars(model)


# cfg_args and model.json


def test_cfg_args_is_the_known_line(tmp_path):
    args = _parse("-s", "/abs", "-m", "out", "--eval", "--antialiasing", "--seed", "3", "--init_pcd_path", "x.ply")
    write_cfg_args(tmp_path, args)
    assert (tmp_path / "cfg_args").read_text() == (
        "Namespace(sh_degree=3, source_path='/abs', model_path='out', images='images', depths='', resolution=-1, "
        "white_background=False, train_test_exp=False, data_device='cuda', eval=True)"
    )


def test_cfg_args_of_others_are_read(tmp_path):
    file = tmp_path / "cfg_args"
    # Alphabetical order, 2023's keys only, a Windows path, a fork's own keys with any literals.
    file.write_text(
        "Namespace(data_device='cuda', eval=False, images='it\\'s', iterations=[7000, -1], rates={'xyz': 1e-4, 'rest': "
        "[None, b'x']}, resolution=-1, sh_degree=2, size=(800, -600), source_path='C:\\\\data\\\\\"x\"', "
        "start_checkpoint=None, tags={'a'}, white_background=True)\n"
    )
    assert read_cfg_args(tmp_path) == {
        "data_device": "cuda", "eval": False, "images": "it's", "resolution": -1, "sh_degree": 2,
        "source_path": 'C:\\data\\"x"', "white_background": True,
    }  # fmt: skip


# fmt: off
@pytest.mark.parametrize("text", [
    "", "not python (", "dict(sh_degree=3)", "argparse.Namespace(sh_degree=3)", "Namespace(3)",
    "Namespace(**{'sh_degree': 3})", "Namespace(sh_degree=1+2)", "Namespace(sh_degree=-True)",
    "Namespace(sh_degree=3.0)", "Namespace(sh_degree=True)", "Namespace(sh_degree=None)", "Namespace(eval=1)",
    "Namespace(source_path=b'x')", "Namespace(source_path=''.join([]))",
    "Namespace(source_path=open('PROOF', 'w').name)", "Namespace(other=__import__('os').mkdir('PROOF'))",
    "Namespace(other=[open('PROOF', 'w')])", "Namespace(source_path=f'{1}')", "Namespace(other={[]: 1})",
    "Namespace(other=" + "-" * 900 + "1)", "Namespace(" + "-" * 5000 + "1)", "Namespace(a=\0)", "(" * 10_000,
])
# fmt: on
def test_cfg_args_is_never_executed(tmp_path, text, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cfg_args").write_text(text)
    with pytest.raises(UserError, match="cfg_args"):
        read_cfg_args(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["cfg_args"]


def test_model_json_has_what_is_stored_there_with_sorted_keys(tmp_path):
    write_model_json(tmp_path, _parse("--invert_masks", "--seed", "7", "--lambda_dssim", "0.5"), antialiasing=True)
    record = read_model_json(tmp_path)
    assert list(record) == sorted(record) and record.pop("version")
    assert record == {
        "antialiasing": True, "invert_masks": True, "optimizer_type": "default", "projection": "ewa",
        "seed": 7, "strategy": "auto", "options": {"lambda_dssim": 0.5},
    }  # fmt: skip
    write_cfg_args(tmp_path, argparse.Namespace())
    del record["options"]
    defaults = {"masks": "", "mask_meaning": "auto", "lenses": "auto", "refine_poses": False,
                "appearance": "none", "holdout": "every8"}  # fmt: skip
    assert read_stored_options(tmp_path) == {**MODEL, **record, **defaults}




# Commands that load a model


def _combined(*argv: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    model, pipeline = ModelParams(parser, sentinel=True), PipelineParams(parser)
    args = get_combined_args(parser, argv)
    typed = {"typed_sh_degree": args.typed_sh_degree}
    return argparse.Namespace(**vars(model.extract(args)), **vars(pipeline.extract(args)), **typed)


def test_options_that_would_have_no_effect_are_left_out():
    parser = argparse.ArgumentParser()
    model = ModelParams(parser, sentinel=True, without=("images_to_load",))
    assert "--images_to_load" not in parser.format_help() and "--masks" in parser.format_help()
    assert model.extract(parser.parse_args([])).images_to_load == 0


def test_the_command_line_wins_over_the_file(tmp_path):
    (tmp_path / "cfg_args").write_text(
        "Namespace(sh_degree=1, source_path='/data', model_path='elsewhere', images='images_4', depths='d', "
        "resolution=2, white_background=True, train_test_exp=False, data_device='cpu', eval=True)"
    )
    args = _combined("-m", str(tmp_path), "-r", "8", "-i", "images")
    assert (args.resolution, args.images, args.model_path) == (8, "images", str(tmp_path))
    assert (args.sh_degree, args.source_path, args.white_background, args.eval) == (1, "/data", True, True)
    assert (args.data_device, args.depths, args.images_to_load) == ("cpu", "d", 0)
    # A degree that was typed is told from one that is stored.
    assert (args.typed_sh_degree, _combined("-m", str(tmp_path), "--sh_degree", "1").typed_sh_degree) == (None, 1)




def test_no_model_folder(tmp_path):
    for said, words in {
        "-m": (),
        "no cfg_args in": ("-m", str(tmp_path)),
        ".*nope does not exist; pass the folder that train.py wrote": ("-m", str(tmp_path / "nope")),
        ".* is a file, and no model folder; pass": ("-m", __file__),
    }.items():
        with pytest.raises(UserError, match=said):
            _combined(*words)


# Abbreviations




def _meaning(parser: argparse.ArgumentParser, prefix: str) -> str | None:
    """The option that an abbreviation sets; None if the abbreviation is refused."""
    for value in ([], ["1"]):
        try:
            args = parser.parse_args([prefix, *value])
        except SystemExit:
            continue
        return next(name for name, given in vars(args).items() if given != parser.get_default(name))
    return None


def test_abbreviations_of_the_reference_mean_the_same_in_spite_of_our_options(capsys):
    reference, parser = argparse.ArgumentParser(), OptionParser()
    for group in (ModelParams, PipelineParams, OptimizationParams):
        group(parser)
        group(reference, without=OURS)
    names = [name for name in REFERENCE if not name.startswith(("depth_", "exposure_"))]
    for prefix in sorted({f"--{name[:end]}" for name in names for end in range(1, len(name) + 1)}):
        meant = _meaning(reference, prefix)
        if meant:
            assert (prefix, _meaning(parser, prefix)) == (prefix, meant)
    assert _meaning(parser, "--im") == "images"
    assert _meaning(parser, "--m") == "model_path"
    assert _meaning(parser, "--max") == "max_num_splats"
    assert _meaning(parser, "--images_") == "images_to_load"
    assert _meaning(parser, "--s") is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--densify_untill_iter=5"], "there is no option --densify_untill_iter=5; did you mean --densify_until_iter"),
        (["--xyzzy=3"], "there is no option --xyzzy=3 ("),
        (["--eval", "true"], "true belongs to no option"),
        (["--eval=true"], "argument --eval: takes no value, got 'true'"),
        (["--iterations", "7k"], "argument --iterations: takes a whole number"),
        (["--time_budget", "5m"], "argument --time_budget: takes a number without a unit"),
    ],
)
def test_a_mistyped_option_gets_one_line(capsys, words, said):
    with pytest.raises(SystemExit) as ended:
        train.parse(["-s", "x", *words])
    (line,) = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2 and line.startswith(f"error: {said}")
    assert line.endswith(" --help-all lists all options)")
