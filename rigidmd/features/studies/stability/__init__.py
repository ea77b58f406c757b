"""Stress tests of the engine, each compared with a known answer."""

from rigidmd.features.studies.kind_study import studies
from rigidmd.features.studies.stability import molecules  # noqa: F401  (registers builders)

for _, study in studies():
    study.add_stability_cases()
