"""Registers the method with NerfBaselines, which reads this file where NERFBASELINES_REGISTER names it."""

from nerfbaselines import register

ID = "gaussian-splatting-apache"
TIME = 120  # seconds, of the preset time_budget

register(
    {
        "id": ID,
        "method_class": "applications.nerfbaselines.method:GaussianSplatting",
        "backends_order": ["python"],
        "required_features": ["color", "points3D_xyz", "points3D_rgb"],
        "supported_camera_models": ["pinhole", "opencv", "opencv_fisheye", "full_opencv"],
        "supported_outputs": ["color"],
        "metadata": {
            "name": "Gaussian Splatting (Apache-2.0)",
            "description": "3D Gaussian Splatting, written anew from the papers. Without a preset it is the method of "
            "the paper with adaptive density control. Photos of distorting lenses train as they are.",
            "paper_title": "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
            "paper_authors": ["Bernhard Kerbl", "Georgios Kopanas", "Thomas Leimkühler", "George Drettakis"],
            "paper_link": "https://arxiv.org/abs/2308.04079",
            "licenses": [{"name": "Apache-2.0"}],
        },
        "presets": {
            "adc": {"@description": "Adaptive density control, as in the paper; the default.", "strategy": "adc"},
            "mcmc": {
                "@description": "Relocation and noise (Kheradmand et al. 2024), at most 1,000,000 Gaussians.",
                "strategy": "mcmc",
                "max_num_splats": 1_000_000,
            },
            "budget": {
                "@description": "Half the iterations, growing to a number of Gaussians where the error is.",
                "strategy": "budget",
                "iterations": 15_000,
            },
            "time_budget": {
                "@description": f"{TIME} seconds of training; --set time_budget=SECONDS gives others.",
                "time_budget": TIME,
            },
        },
    }
)
