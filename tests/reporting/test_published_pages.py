"""Every published page is what its report writes of the published data today."""

import importlib
import json
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = {
    "accuracy": "simulation.studies.accuracy_report:accuracy_page",
    "benchmark": "export.bench.report:benchmark_page",
    "hostile_load": "tests.benchmarks.hostile:hostile_page",
    "hard_cases": "tests.hard_cases.__main__:hard_cases_page",
    "identify": "simulation.studies.identify.page:identify_page",
    "motion_bounds": "simulation.studies.motion_bounds.report:bounds_page",
    "commissioning": "simulation.studies.commissioning_page:commissioning_page",
    "drawn_worlds": "simulation.studies.drawn_worlds:drawn_worlds_page",
    "foreign_check": "simulation.studies.witness.check_page:foreign_check_page",
    "foreign_world": "simulation.studies.witness.sealed_page:foreign_world_page",
    "pace": "simulation.studies.pace.report:pace_page",
    "serving": "tests.benchmarks.serving_report:serving_page",
    "transfer": "training.report.transfer:transfer_page",
    "trust": "simulation.studies.trust:trust_page",
    "slip_report": "simulation.studies.slip.report:slip_page",
    "soak": "tests.service.soak.report:soak_page",
}


@pytest.mark.parametrize("name", PAGES)
def test_a_published_page_is_written_from_its_data(name: str) -> None:
    module, function = PAGES[name].split(":")
    data = json.loads((DOCS / f"{name}.json").read_text())
    assert getattr(importlib.import_module(module), function)(data) == (DOCS / f"{name}.md").read_text()
