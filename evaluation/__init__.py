"""What full_eval.py does: a table of scenes is trained, rendered and scored, and one report is made of it.

scenes, configs, runs        what is to be done: which folders, under which options, into which model folders
child, lock, record, stages  doing it: one stage is one subprocess; what is finished is remembered in the model folder
model_folder, results        reading what a model folder holds
summary, tradeoff, published spread over seeds, error against time, and comparison with published tables
figures, contact_sheet       pictures
document, markdown, html     the report's content, once, and its two renderings; report writes all files
machine                      where and with what it ran
results_page                 tables of docs/results/training.md from report.json
"""
