"""A network of the full-size run on arrays of a few maps: trained, read back, exported, packed and unpacked."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

from benchmarks.accuracy import full_size
from lab.training.data.map_arrays import ArrayMaker
from lab.training.data.samples import DataConfig
from lab.training.train_dense import load_best, load_summary
from models.perception.find.onnx_model import DensePredictor
from msgs.values.radar import RadarSetup

PLACES = 40


def test_a_network_goes_from_arrays_to_a_run_folder_elsewhere(tmp_path: Path) -> None:
    work, out = tmp_path / "work", tmp_path / "out"
    out.mkdir()
    _arrays(work / "arrays")
    (work / full_size.REPORTING).mkdir()
    splits = {"train": [], "validation": [0, 1], "test": [2], "test_sha256": "0" * 64}
    (work / full_size.REPORTING / "splits.json").write_text(json.dumps(splits))
    ends_s = time.monotonic() + 1.0
    plan = full_size.Plan(
        work=work,
        phases_s=(ends_s, ends_s, ends_s),
        ends_s=ends_s,
        seed=0,
        command="python -m benchmarks.accuracy.full_size",
        minutes=(0.02, 0.02, 0.02),
        tiny=True,
        reads_back=True,
    )
    job = full_size.JOBS[0]
    full_size.train(plan, job)
    DensePredictor(plan.detector)
    full_size.write_results(plan, [job, *full_size.CURVE], out)
    full_size.unpack(out, tmp_path / "runs")
    network, run, _ = load_best(tmp_path / "runs" / job.name)
    assert run.command == plan.command
    assert load_summary(tmp_path / "runs" / job.name).parameters == sum(one.numel() for one in network.parameters())
    found = json.loads((tmp_path / "runs" / full_size.RESULTS).read_bytes())
    assert found["runs"][job.name]["scenes"] == 2 * PLACES
    # what is done is left
    full_size.train(plan, job)


def _arrays(folder: Path) -> None:
    rng = np.random.default_rng(1)
    folder.mkdir(parents=True)
    values = 1e-6 * rng.standard_normal((PLACES, 512, 256, 2)) @ (1.0, 1.0j)
    values[:, 100, 60] += 1e-3
    np.savez(
        folder / "shard-00000.npz",
        values=values.astype(np.complex64),
        noise_power_mw=np.full(PLACES, 2e-12),
        offset=np.arange(PLACES + 1),
        range_m=np.full(PLACES, 21.4),
        azimuth_rad=np.full(PLACES, -0.5),
        path_class=np.zeros(PLACES, np.int64),
    )
    maker = ArrayMaker(DataConfig(), (full_size.DETECTOR_VIEW,), 1, RadarSetup())
    scenes = {"train": None, "validation": [0, 1], "test": [2]}
    for split in full_size.SPLITS:
        maker.make(folder / "shard-00000.npz", folder / f"{full_size.REPORTING}_{split}", scenes[split])
    maker.make(folder / "shard-00000.npz", folder / full_size.FURTHER)
