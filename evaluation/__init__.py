"""The parts of full_eval.py, which trains, renders and scores a table of scenes, and writes one report.

scenes, configs, runs        the plan: scene folders, options, model folders; sets/ has option sets to use
child, record, stages        its execution: each stage is a subprocess; the model folder records finished stages
model_folder, results        readers of model folders
summary, tradeoff, published spread over seeds, error against time, comparison with published tables
option_sets, set_sections    option sets of a scene, and sections about them: reached (seconds to a PSNR), fronts
ground_truth, earlier, peers runs that can be compared, those of earlier calls, curves of other programs
figures, contact_sheet       figures of the report; front_figure draws Pareto fronts
blocks, document              the report's content, and markdown and html its two renderings; report writes all files
peer_curve                   files for peers, made from outputs of other programs; tensorboard_scalars reads some
machine                      description of the machine
results_page                 tables of docs/results/training.md from report.json
"""
