"""The report for papers and programs: report.csv as another program reads it, and the tables of report.tex."""

import csv
import io
import re
from statistics import fmean

from report_runs import run_of, set_runs

from applications.evaluation.paper import format_csv, format_tex
from applications.evaluation.report import make_report


def test_a_row_for_each_run_and_for_each_mean():
    failed = run_of("adc", 2, (10, 20.0, 100)) | {"failure": {"stage": "train"}, "iterations": {}}
    both = run_of("one, two", 0, (10, 20.0, 100), (20, 21.0, 200))
    both["iterations"] |= {"10": both["iterations"]["20"] | {"PSNR": 20.5, "ply_mb": None}, "15": {"views": 0}}
    report = make_report(["x"], [*set_runs("attic"), *set_runs("brick"), failed, both])
    rows = list(csv.DictReader(io.StringIO(format_csv(report))))
    assert {len(row) for row in rows} == {26} and len(rows) == 12 + 1 + 2 + 3
    runs, means = [row for row in rows if row["scenes"] == "1"], [row for row in rows if row["scenes"] == "2"]
    first, mean = runs[0], means[0]
    assert [first[name] for name in ("group", "scene", "config", "seed")] == ["scenes", "attic", "adc", "0"]
    assert [first[name] for name in ("PSNR", "gaussians", "LPIPS", "failed")] == ["31.0", "300", "", ""]
    assert [mean[name] for name in ("scene", "config", "seed", "model")] == ["mean of 2 scenes", "adc", "", ""]
    of_adc = [row for row in runs if row["config"] == "adc" and not row["failed"]]
    assert len(of_adc) == 4 and float(mean["PSNR"]) == fmean(float(row["PSNR"]) for row in of_adc)
    (row,) = [row for row in runs if row["failed"]]
    assert (row["failed"], row["seed"], row["PSNR"], row["iteration"]) == ("train", "2", "", "")
    twice = [(row["iteration"], row["PSNR"], row["ply_mb"]) for row in runs if row["config"] == "one, two"]
    assert sorted(twice) == [("10", "20.5", ""), ("20", "21.0", "0.02")]


def test_tables_that_tex_reads():
    """By TeX's rules; pdflatex compiled the same in an article, with the package booktabs and without."""
    name = "a--b_% #&$~^{x} <é>|\n地\\\udce9"
    other = run_of(name, 1, (10, 20.0, 100), scene="brick", ground_truth_sha256="b" * 64)
    text = format_tex(make_report(["x"], [*set_runs("attic"), *set_runs("brick"), other]))
    assert text.replace("é", "").isascii() and "\n\n" not in text and "--" not in text
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
    main, apart = re.findall(r"\\begin\{table\}.*?\\end\{table\}", text, re.DOTALL)
    columns = re.search(r"\\begin\{tabular\}\{(\w+)\}", main)[1]
    lines = [line for line in main.splitlines() if line.endswith(r" \\")]
    heads = [line for line in lines if line.startswith(f"\\multicolumn{{{len(columns)}}}{{l}}")]
    assert [re.search(r"\{([^}]*)\} \\", line)[1] for line in heads] == ["attic", "brick", "mean of 2 scenes"]
    assert lines.index(heads[0]) == 1 and lines.index(heads[2]) == 9 and len(lines) == 1 + 3 + 9
    assert {line.count(" & ") for line in lines if line not in heads} == {len(columns) - 1}
    assert lines[0].startswith(r"options & PSNR (dB) & SSIM & training (s) & Gaussians")
    assert lines[2].startswith(r"adc & 31.20 $\pm$ 0.28 & - &") == lines[10].startswith(r"adc & 31.20 $\pm$ 0.28 & - &")
    assert main.count("\\midrule\n") == 3 and "test views, iteration 30, seeds 0 1. Means" in main
    escaped = r"a-{}-b\_\% \#\&\$\textasciitilde{}\textasciicircum{}\{x\} $<$é$>$$|$ \textbackslash{}u5730"
    assert f"\n{escaped}\\textbackslash{{}}\\textbackslash{{}}udce9 & 20.00 &" in apart
    assert "Scored on other ground truth, so not to be compared with other rows." in apart
