from diff_gaussian_rasterization.gsplat.programs import run

run()
