"""Training of ResidualReflectNet: schedule, checkpoints, validation, as section 3.3 states them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from lab.networks.residual_reflect_net import ResidualReflectNet
from lab.training.data.residual_samples import FoldedImages, recovered_scores
from lab.training.loop import TrainingLoop
from lab.training.pretrained import load_initial
from lab.training.run_folder import BEST, adopt_config, load_config, load_state
from models.perception.mirrors.recovery import ReflectionState
from models.perception.mirrors.residual_model import bounded, in_frames, wall_frames

#: Longest gradient.
_CLIP_NORM = 1.0
#: Weight of an image without a wall of its own (eta = 1) in the loss, relative to 1 for all others.
_UNRELIABLE_WEIGHT = 0.1


class TrainResidualConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Schedule of a run."""

    epochs: int = 100
    seed: int = 0
    batch_size: int = 128
    learning_rate: float = 1e-4
    #: Images that the mirror law leaves further than this from their true position were mirrored elsewhere: they are
    #: excluded from training and from the selection of the checkpoint. The published training uses all (1000).
    reach_m: float = 2.0
    threads: int = 1
    #: File of initial weights.
    init: str = ""

    def __post_init__(self) -> None:
        if not self.reach_m > 0.0:
            raise ValueError(f"train.reach_m must be positive, got {self.reach_m}")


class ResidualRunConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Complete configuration of a run; its JSON lies in the run folder."""

    training: TrainResidualConfig
    #: Folder of the data set, and the hash of its test scenes; detector and its SHA-256.
    data: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class ResidualEpoch:
    """Result of one epoch with the vehicle's processing: on validation scenes, corrections bounded."""

    epoch: int
    train_loss: float
    #: Mean |error x| + |error y| of the recovered positions within reach, and F1 of all at 1 m; `_without` are those of
    #: the mirror law alone.
    recovered_l1_m: float
    recovered_l1_without_m: float
    recovered_f1: float
    recovered_f1_without: float
    is_best: bool


class ResidualTraining(TrainingLoop[ResidualEpoch]):
    """One run; `run_dir` receives the resolved configuration too.

    Raises `ValueError` if there is nothing to train or validate on.
    """

    def __init__(self, config: ResidualRunConfig, train: FoldedImages, validation: FoldedImages, run_dir: Path) -> None:
        self.run_config, self.config = config, config.training
        super().__init__(run_dir, self.config.epochs, _CLIP_NORM, ResidualEpoch)
        self.device = torch.device("cpu")
        reach_m = self.config.reach_m
        samples = train.select(train.within(reach_m))
        for name, count in (("train", len(samples)), ("validation", int(validation.within(reach_m).sum()))):
            if count == 0:
                raise ValueError(f"{name} scenes must give images within {reach_m} m of their true place, gave none")
        torch.set_num_threads(self.config.threads)
        torch.manual_seed(self.config.seed)
        self.network = ResidualReflectNet()
        self.optimiser = torch.optim.Adam(self.network.parameters(), self.config.learning_rate)
        self.scene, self.validation = samples.scene, validation
        frames = wall_frames(samples.reflection)
        self.inputs = tensors(in_frames(samples.reflection, frames))
        self.target = _tensor(frames.from_radar(samples.target_m))
        self.weight = _tensor(np.where(samples.state[:, 5] > 0.5, _UNRELIABLE_WEIGHT, 1.0))
        self.without = recovered_scores(validation, np.zeros_like(validation.folded_m), reach_m)
        run_dir.mkdir(parents=True, exist_ok=True)
        adopt_config(run_dir, config)
        if not self.resume() and self.config.init:
            load_initial(self.network, Path(self.config.init))

    def train_epoch(self, epoch: int) -> float:
        """Train one epoch and return its mean loss; `ValueError` names the batch whose loss is not finite."""
        # the epoch's own seed: a resumed run draws the same numbers
        order = torch.from_numpy(np.random.default_rng((self.config.seed, epoch)).permutation(len(self.target)))
        losses = [self._step(batch, epoch, index) for index, batch in enumerate(order.split(self.config.batch_size))]
        return float(np.mean(losses))

    def _step(self, batch: Tensor, epoch: int, index: int) -> float:
        answer = self.network(*(tensor[batch] for tensor in self.inputs))
        loss = residual_loss(answer, self.target[batch], self.weight[batch])
        if not torch.isfinite(loss):
            scenes = np.unique(self.scene[batch.numpy()]).tolist()
            raise ValueError(
                f"loss must be finite, got {loss.item()} in epoch {epoch}, batch {index}, of scenes {scenes}"
            )
        self.descend(loss)
        return loss.item()

    def judge(self, epoch: int, train_loss: float) -> ResidualEpoch:
        """Return the scores on the validation scenes."""
        offsets_m = network_offsets(self.network, self.validation)
        scores = recovered_scores(self.validation, offsets_m, self.config.reach_m)
        return ResidualEpoch(
            epoch=epoch,
            train_loss=train_loss,
            recovered_l1_m=scores.l1_m,
            recovered_l1_without_m=self.without.l1_m,
            recovered_f1=scores.f1,
            recovered_f1_without=self.without.f1,
            is_best=scores.l1_m < min((entry.recovered_l1_m for entry in self.reports), default=np.inf),
        )


def residual_loss(answer: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Return the weighted mean over the batch of the l1 length of the error, Eq. (25), in metres; 0 if unweighted."""
    error_m = (answer - target).abs().sum(dim=1)
    return (weight * error_m).sum() / weight.sum().clamp_min(1e-9)


def network_offsets(network: nn.Module, folded: FoldedImages) -> np.ndarray:
    """Return corrections [N, 2] in the radar's frame, bounded as on the vehicle."""
    network.eval()
    frames = wall_frames(folded.reflection)
    with torch.no_grad():
        answer = network(*tensors(in_frames(folded.reflection, frames))).numpy().astype(np.float64)
    return bounded(frames.to_radar(answer))


def tensors(reflection: ReflectionState) -> tuple[Tensor, Tensor, Tensor]:
    """Return the tensors that the network takes."""
    return _tensor(reflection.images_m), _tensor(reflection.patch_m), _tensor(reflection.state)


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def load_best_residual(run_dir: Path) -> tuple[ResidualReflectNet, ResidualRunConfig, int]:
    """Return the best network of a run in evaluation mode, the run's configuration, and the network's epoch.

    Raises `ValueError` if the folder holds none, naming the file.
    """
    config = load_config(run_dir, ResidualRunConfig)
    network = ResidualReflectNet()
    state = load_state(run_dir / BEST)
    network.load_state_dict(state["network"])
    return network.eval(), config, int(state["epoch"])
