"""The parts of full_eval.py, which trains, renders and scores scenes and writes one report.

scenes, configs, runs        the work: scene folders, option sets, and the model folders they go to
child, lock, record, stages  its execution: one stage is one subprocess; the model folder records finished stages
model_folder, results        readers of a finished model folder
summary, tradeoff, published spread over seeds, error against time, and comparison with published tables
figures, contact_sheet       pictures
document, markdown, html     the report's content and its two renderings; report writes all files
machine                      hardware and software of a run
results_page                 tables of docs/results/training.md from report.json
"""
