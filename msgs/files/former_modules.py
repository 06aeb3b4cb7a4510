"""Modules by their former names, which scripts and launch files know: the module itself, by its former room too."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

#: Former name of a module, or of a room, and what it is called; the longest counts.
FORMER = {
    "contrib.boards.radar_driver": "contrib.boards.phaser_radar",
    "models.perception.detection": "models.perception.find",
    "models.perception.detection.stage": "models.perception.find.maps_to_peaks",
    "models.perception.detections": "models.perception.target_lists",
    "models.perception.detections.stage": "models.perception.target_lists.targets_to_peaks",
    "models.perception.evidence": "models.perception.see",
    "models.perception.evidence.answers": "models.perception.see.evidence_answers",
    "models.perception.evidence.predictor": "models.perception.see.evidence_predictor",
    "models.perception.forming": "models.perception.form",
    "models.perception.forming.stage": "models.perception.form.beams_to_maps",
    "models.perception.geometry": "models.perception.mirrors",
    "models.perception.geometry.association": "models.perception.mirrors.image_walls",
    "models.perception.geometry.mirrors": "models.perception.mirrors.mirror_table",
    "models.perception.geometry.objects": "models.perception.mirrors.recovered_objects",
    "models.perception.geometry.stage": "models.perception.mirrors.peaks_to_view",
    "models.perception.tracking": "models.perception.track",
    "models.perception.tracking.association": "models.perception.track.joint_association",
    "models.perception.tracking.stage": "models.perception.track.views_over_scans",
    "models.vehicle.can_state": "models.vehicle.can_decoder",
    "models.vehicle.frame_check": "models.vehicle.can_frame",
    "models.vehicle.mapping": "models.vehicle.can_mapping",
    "nodes.bridges.foxglove": "contrib.foxglove.foxglove_bridge",
    "nodes.bridges.ros2": "contrib.ros2.ros2_bridge",
    "nodes.dca1000_radar": "contrib.boards.dca1000_radar",
    "nodes.drivers.detections_radar": "contrib.boards.detections_radar",
    "nodes.drivers.recorded_sensors": "contrib.imports.recorded_sensors",
    "nodes.link": "contrib.two_machines.link",
    "nodes.radar_driver": "contrib.boards.phaser_radar",
    "sim_player.effects.names": "sim_player.trace.effect_names",
    "sim_player.scene.meshes": "sim_player.bodies.meshes",
    "sim_player.scene.reach": "sim_player.paths.reach",
    "sim_player.scene.visibility": "sim_player.paths.visibility",
    "sim_player.trace.bounce": "sim_player.scene.bounce",
    "sim_player.trace.conversion": "sim_player.paths.conversion",
    "sim_player.trace.mesh_rcs": "lab.full_wave.shot_rays",
    "sim_player.trace.path_tracks": "sim_player.paths.path_tracks",
    "sim_player.trace.paths": "sim_player.trace.path_table",
    "sim_player.trace.ray_tracing": "sim_player.paths.ray_tracing",
    "sim_player.trace.segments": "sim_player.scene.segments",
    "sim_player.trace.truth": "sim_player.paths.truth",
    "sim_player.trace.vertices": "sim_player.paths.vertices",
}


def present_name(module: str) -> str:
    """Return what a module is called; other names as they are."""
    known = module
    while known:
        if known in FORMER:
            return FORMER[known] + module[len(known) :]
        known = known.rpartition(".")[0]
    return module


class _FormerNames:
    """Finder and loader of modules by their former names."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return None if present_name(name) == name else ModuleSpec(name, self)  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(present_name(spec.name))
        self._own: tuple[Any, ...] = module.__spec__, module.__loader__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # the import system has put the former name's in their place
        module.__spec__, module.__loader__ = self._own


def know_former_names() -> None:
    """Let modules be imported by their former names too."""
    if not any(isinstance(finder, _FormerNames) for finder in sys.meta_path):
        # ahead of all others: they would load a room's modules once more under its former name
        sys.meta_path.insert(0, _FormerNames())
