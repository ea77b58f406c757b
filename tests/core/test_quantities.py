"""The table of quantities: a row is all that a quantity takes."""

import csv
import json
import re

import pytest
from support.common import ROOT, small_scene

from rigidmd.core.quantities import QUANTITIES, Mean, Quantity, with_means
from rigidmd.features.studies.sweep.table import SweepRow, Table, summarise_run
from rigidmd.features.view.run_page import write_report
from rigidmd.run import Simulation
from rigidmd.run.record import read_record
from rigidmd.run.report import short_summary, summary_text


def test_one_row_adds_a_quantity_everywhere(tmp_path, monkeypatch):
    """In the log, results, observations, summary, both reports, the page and the table of a sweep."""
    row = Quantity(
        "translation",
        "Translation",
        "kJ/mol",
        "kinetic energy of translation",
        lambda observation: observation.kinetic_translation,
        mean=Mean("translation{}_kJ_mol", "translation", is_main=True),
    )
    monkeypatch.setitem(QUANTITIES, row.name, row)
    stages = [{"duration_ps": 0.2, "timestep_fs": 5.0}]
    output = {"log_interval_ps": 0.01, "figures": False}
    folder = tmp_path / "run"
    simulation = Simulation(small_scene({"argon": 20}, 20.0, stages=stages, output=output), folder)
    results = simulation.run()
    # argon has no other motion
    assert results["translation"].tolist() == results["kinetic"].tolist()
    assert results.units["translation"] == "kJ/mol"
    assert simulation.observation.translation == results["translation"][-1]
    with (folder / "log.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [float(line["Translation (kJ/mol)"]) for line in lines] == results["kinetic"].tolist()
    (stage,) = json.loads((folder / "summary.json").read_text())["stages"]
    assert stage["translation_kJ_mol"] == pytest.approx(results["kinetic"].mean())
    assert stage["translation_error_kJ_mol"] > 0
    mean = rf"{stage['translation_kJ_mol']:.1f}\d*\s±\s[\d.]+"
    for text_of in (summary_text, short_summary):
        assert re.search(rf"\n  translation +{mean} +kJ/mol", text_of(results.summary))
    write_report(folder, tmp_path / "page.html")
    page = re.sub("<[^>]*>", "|", (tmp_path / "page.html").read_text("utf-8"))
    assert re.search(rf"translation\|\s*kJ/mol[|]+{mean}\|", page)
    means = summarise_run(read_record(folder))
    table = Table(tmp_path, [], [SweepRow({}, {None: means})], list(means))
    assert row.header in table.main_columns()
    assert re.search(rf"\b{stage['translation_kJ_mol']:.1f}", str(table.brief()))


def test_the_reference_has_every_column():
    page = (ROOT / "rigidmd" / "docs" / "reference" / "files.md").read_text("utf-8")
    part = page.partition("## Columns of log.csv")[2].partition("\n## ")[0]
    named = set(re.findall(r"`([^`]+)`", part))
    assert QUANTITIES.keys() <= named
    headers = {row.header for row in QUANTITIES.values() if row.header and not row.of_tensor}
    assert headers <= named


def test_means_of_a_stage_have_keys_with_their_errors():
    keys = [mean.key for _, mean in with_means()]
    assert len(set(keys)) == len(keys)
    assert all(key.count("{}") == 1 for key in keys)
