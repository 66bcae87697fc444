"""The parts of full_eval.py, which trains, renders and scores a table of scenes, and writes one report.

scenes, configs, runs    the plan: scene folders, options, model folders and their records; sets/ has option sets to use
child, stages            its execution: each stage is a subprocess
model_folder, results    readers of model folders, and of the report of earlier calls
summary, option_sets     spread over seeds; option sets beside each other: seconds to a PSNR, fronts, the cheapest
published, peers         published tables, and curves of other programs (peer_curve makes their files)
document, pages, report  the report's content as plain data, its HTML and Markdown, all its files
figures, contact_sheet   its figures, and pictures of test views
machine                  description of the machine
results_page             tables of docs/results/training.md from report.json
"""
