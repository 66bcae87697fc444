"""Measurements of trainings, and full_eval.py, which trains, renders and scores a table of scenes.

From runs to the report, by the records of trainings (splatting/records):
plan, configs               scene folders, options, model folders and their records; sets/ has option sets to use
stages, child               execution of the plan: each stage is a subprocess, one at a time or one on each GPU
model_folder, renders       readers of model folders, and of the sets of views rendered there
results, comparison         a run's numbers; those of several: spread, option sets, published tables (published.json)
gains                       paired differences over seeds, with intervals and verdicts
tables, report, figures     numbers as tables of text; report.json, its pages (report.jinja in two forms) and figures

The command peer_curve makes CSV files of other programs' output.
"""
