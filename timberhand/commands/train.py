"""``timberhand train``: train the networks and write their weights with a model card."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

app = typer.Typer(no_args_is_help=True, help="Train a network and write its weights with a model card.")

OUT_HELP = "Weights to write; the model card is written beside them as .md."
Out = Annotated[Path, typer.Option(help=OUT_HELP)]
OptionalOut = Annotated[Path | None, typer.Option(help=OUT_HELP)]
Seed = Annotated[int, typer.Option(help="The same seed gives the same weights on the same computer.")]
Pictures = Annotated[int, typer.Option(min=1, help="Number of rendered pictures; 0.6 MB each.")]
Rate = Annotated[float, typer.Option(min=1e-6, max=0.1, help="Peak learning rate.")]
Large = Annotated[int, typer.Option(min=0, help="Pictures of twice the size, for half of the training; 2.5 MB each.")]
Folder = Annotated[Path | None, typer.Option(help="Folder of the pictures (default: ~/.cache/timberhand/pictures).")]


class Labels(StrEnum):
    """The training labels of the grasp network."""

    CORNELL = "cornell"
    PHYSICAL = "physical"


@app.command()
def grasp(
    data: Annotated[
        Path | None, typer.Option(help="Folder of Cornell samples: pcdNNNNd.tiff and pcdNNNNcpos.txt.")
    ] = None,
    labels: Annotated[
        Labels, typer.Option(help="Rectangles of Cornell samples, or a physical rule on simulated piles of logs.")
    ] = Labels.CORNELL,
    out: OptionalOut = None,
    seed: Seed = 1,
    epochs: Annotated[
        int | None, typer.Option(min=1, help="Training epochs (default: as for the shipped weights).")
    ] = None,
) -> None:
    """Train paper A's grasp network on Cornell samples or on rendered piles of logs, on one core.

    Ctrl-C keeps the last checkpoint; the same command continues from there.

    [bold]Examples[/bold]

      timberhand train grasp --data ~/cornell

      timberhand train grasp --data ~/cornell --epochs 30 --out my.onnx

      timberhand train grasp --labels physical     needs no data

      timberhand experiment grasp-network --data ~/other_cornell
    """
    prepare_torch()
    weights = out or Path(f"grasp_{labels.value}.onnx")
    if labels is Labels.PHYSICAL:
        if data is not None:
            raise CommandFailed(
                "train.data-not-wanted",
                "--data belongs to --labels cornell; physical labels need no data",
                ExitCode.USAGE,
            )
        _grasp_physical(weights, seed, epochs)
    elif data is None:
        raise CommandFailed(
            "train.data-missing",
            "--data is missing: give the folder of Cornell samples, or use --labels physical",
            ExitCode.USAGE,
        )
    else:
        _grasp_cornell(data, weights, seed, epochs)


def _grasp_physical(weights: Path, seed: int, epochs: int | None) -> None:
    from training.grasp import physical_weights

    passes = epochs or physical_weights.EPOCHS
    _train_on_pictures(
        weights, None, lambda _, screen: physical_weights.produce(seed, weights, screen, epochs=passes)[1]
    )


def _grasp_cornell(data: Path, out: Path, seed: int, epochs: int | None) -> None:
    from rich.console import Console

    from training.grasp import network_training as training
    from training.grasp.cornell import load
    from training.grasp.cornell_weights import produce

    screen = Console(stderr=True)
    samples = load(data)
    try:
        weights, card = produce(samples, seed, epochs or training.EPOCHS, out, screen)
    except KeyboardInterrupt:
        raise CommandFailed(
            "train.interrupted",
            "interrupted; the same command continues from the last checkpoint",
            ExitCode.INTERRUPTED,
        ) from None
    screen.print(f"{weights}, {card}", highlight=False)


@app.command()
def segmentation(
    variant: Annotated[str, typer.Option(help="Input channels of the network: rgbd or depth.")] = "rgbd",
    out: OptionalOut = None,
    seed: Seed = 1,
    steps: Annotated[int, typer.Option(min=1, help="Training batches.")] = 6000,
    pictures: Pictures = 25_088,
    folder: Folder = None,
    learning_rate: Rate = 3e-3,
    start: Annotated[
        Path | None, typer.Option(help="Initial weights; for depth those of rgbd are possible, too (default: random).")
    ] = None,
    large: Large = 0,
) -> None:
    """Train the network that segments logs, on rendered pictures, on one core.

    The pictures are rendered first and kept for the next training. Ctrl-C keeps
    the last checkpoint; the same command continues from there.

    [bold]Examples[/bold]

      timberhand train segmentation

      timberhand train segmentation --variant depth --steps 12000

      timberhand train segmentation --pictures 256 --steps 50     a short trial
    """
    prepare_torch()
    from autonomy.perception.segmentation.network import CHANNELS
    from training.detection.detector_weights import Plan, produce

    if variant not in CHANNELS:
        raise CommandFailed(
            "train.unknown-variant", f"variant {variant!r} is unknown; use one of {', '.join(CHANNELS)}", ExitCode.USAGE
        )
    weights = out or Path(f"logs_{variant}.onnx")
    plan = Plan(pictures, steps, seed, learning_rate, start, large)
    _train_on_pictures(weights, folder, lambda kept, screen: produce(variant, plan, kept, weights, screen))


@app.command()
def detector(
    out: Out = Path("log_boxes.onnx"),
    seed: Seed = 1,
    steps: Annotated[int, typer.Option(min=1, help="Training batches.")] = 4000,
    pictures: Pictures = 25_088,
    folder: Folder = None,
    learning_rate: Rate = 3e-3,
    large: Large = 0,
    start: Annotated[Path | None, typer.Option(help="Initial weights (default: random).")] = None,
) -> None:
    """Train a detector in the role of paper B's, boxes of logs from color, on rendered pictures, on one core.

    The pictures are those of [bold]train segmentation[/bold]. Ctrl-C keeps the
    last checkpoint; the same command continues from there.

    [bold]Examples[/bold]

      timberhand train detector

      timberhand train detector --pictures 256 --steps 50     a short trial
    """
    prepare_torch()
    from training.detection.detector_weights import Plan, produce_boxes

    plan = Plan(pictures, steps, seed, learning_rate, start, large)
    _train_on_pictures(out, folder, lambda kept, screen: produce_boxes(plan, kept, out, screen))


@app.command()
def scorers(
    out: Annotated[
        Path, typer.Option(help="Folder of the segment_merging and segment_quality weights and their cards.")
    ] = Path(),
    seed: Seed = 1,
    pictures: Annotated[int, typer.Option(min=2, help="Number of rendered pictures; 2.5 MB each.")] = 1024,
    folder: Folder = None,
    weights: Annotated[
        Path | None, typer.Option(help="Weights of the segmentation network (default: the shipped ones).")
    ] = None,
) -> None:
    """Train the scorers that decide which segments belong to one log, and how well a region fits one.

    They learn from the output of the network of [bold]train segmentation[/bold]:
    train them again after it.

    [bold]Examples[/bold]

      timberhand train scorers

      timberhand train scorers --pictures 64     a trial in a minute
    """
    prepare_torch()
    from training.detection.scorer_weights import produce

    _train_on_pictures(out, folder, lambda kept, screen: produce(pictures, seed, kept, out, weights, screen))


class Renderer(StrEnum):
    """The path tracers."""

    ANY = "any"
    OWN = "own"
    BLENDER = "blender"


class Device(StrEnum):
    """Where the mask network is trained."""

    AUTO = "auto"
    CPU = "cpu"
    CUDA = "cuda"


TracedFolder = Annotated[Path, typer.Argument(help="Folder of the picture sets of the mask network.")]


@app.command("traced-pictures")
def traced_pictures(
    folder: TracedFolder,
    scenes: Annotated[int, typer.Option(min=0, help="Path-traced scenes of two pictures each.")] = 707,
    drawn: Annotated[int, typer.Option(min=0, help="Pictures by the analytic renderer, in files of 8.")] = 1080,
    meshed: Annotated[int, typer.Option(min=0, help="Pictures by pybullet's renderer, in files of 10.")] = 250,
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws other scenes.")] = 0,
    size: Annotated[int, typer.Option(min=48, help="Side of the pictures in px.")] = 512,
    chunks: Annotated[int, typer.Option(min=1, help="Chunks of 64 settled piles of each machine.")] = 2,
    renderer: Annotated[Renderer, typer.Option(help="The own tracer (GPU or CPU), or Blender's.")] = Renderer.ANY,
    blender_python: Annotated[
        Path | None, typer.Option(help="Python of the environment in which bpy is installed.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that draw.")] = 1,
) -> None:
    """Draw the pictures of the mask network: path-traced, analytic, and by pybullet.

    What is there is kept: the same command continues an interrupted one. The own
    tracer is compiled on first use, by nvcc beside a GPU, otherwise by g++.

    [bold]Examples[/bold]

      timberhand train traced-pictures pictures --workers 16

      timberhand train traced-pictures pictures --renderer blender --blender-python blender/bin/python
    """
    from rich.console import Console

    from training.pictures.traced.sets import SetPlan, produce_sets

    screen = Console(stderr=True)
    plan = SetPlan(scenes, drawn, meshed, seed, size, chunks=chunks)
    try:
        produce_sets(folder, plan, renderer.value, workers, blender_python, lambda name: screen.print(name, end=" "))
    except KeyboardInterrupt:
        raise CommandFailed(
            "train.interrupted", "interrupted; the same command continues", ExitCode.INTERRUPTED
        ) from None
    screen.print(f"\n{folder}", highlight=False)


@app.command()
def masks(
    folder: TracedFolder,
    out: Out = Path("logs.onnx"),
    trunk: Annotated[
        Path | None, typer.Option(help="ImageNet weights, torchvision's mobilenet_v2-b0353104.pth (default: random).")
    ] = None,
    photographs: Annotated[
        bool, typer.Option(help="Also the photographs in TIMBERHAND_DATA whose scenes are not judged.")
    ] = False,
    device: Annotated[Device, typer.Option(help="auto is cuda where there is one.")] = Device.AUTO,
    minutes: Annotated[
        float | None, typer.Option(min=0.01, help="Time of the training (default: 530 s, unlimited with --steps).")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Most training batches.")] = None,
    batch: Annotated[int, typer.Option(min=2, help="Windows of a batch.")] = 64,
    side: Annotated[int, typer.Option(min=64, help="Side of a window in px, a multiple of 64.")] = 320,
    seed: Annotated[int, typer.Option(help="With --steps the same seed gives the same weights on a CPU.")] = 7,
) -> None:
    """Train the mask network on the pictures of [bold]train traced-pictures[/bold].

    Writes weights, card and a log (.jsonl). Ctrl-C keeps the last checkpoint;
    the same command continues from there.

    [bold]Examples[/bold]

      timberhand train masks pictures --trunk mobilenet_v2-b0353104.pth --photographs

      timberhand train masks pictures --device cpu --steps 2 --batch 2 --side 64     a short trial
    """
    prepare_torch()

    from training.detection.masks.mask_weights import produce
    from training.detection.masks.run import Run

    if side % 64:
        raise CommandFailed("train.bad-side", f"--side {side} is not a multiple of 64", ExitCode.USAGE)
    seconds = 60.0 * minutes if minutes else math.inf if steps else 530.0
    run = Run(batch=batch, side_px=side, seconds=seconds, steps=steps or 1_000_000, seed=seed)
    limits = (f" --minutes {minutes:g}" if minutes else "") + (f" --steps {steps}" if steps else "")
    command = (
        f"timberhand train masks FOLDER{f' --trunk {trunk.name}' if trunk else ''}"
        f"{' --photographs' if photographs else ''}{limits} --batch {batch} --side {side} "
        f"--seed {seed} --out {out.name}"
    )
    shots = _photographs() if photographs else []
    _train_on_pictures(
        out, folder, lambda kept, screen: produce(kept, run, trunk, shots, device.value, out, command, screen)
    )


def _photographs() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the photographs that may be trained on, and their wood."""
    from experiments.detector.photos import folder, photos
    from experiments.detector.traced import TRAINED_SCENES

    photographs = [(shot.rgb, shot.wood) for shot in photos(folder()) if shot.name in TRAINED_SCENES]
    if not photographs:
        raise CommandFailed("train.no-photographs", f"{folder()} holds no photographs; leave out --photographs")
    return photographs


def _train_on_pictures(weights: Path, folder: Path | None, make: Callable[[Path, Console], Path]) -> None:
    """Train weights on rendered pictures and print their path."""
    from rich.console import Console

    from training.pictures.piles import cache_folder

    screen = Console(stderr=True)
    try:
        card = make(folder or cache_folder().parent / "pictures", screen)
    except KeyboardInterrupt:
        raise CommandFailed(
            "train.interrupted",
            "interrupted; the same command continues from the last checkpoint",
            ExitCode.INTERRUPTED,
        ) from None
    except ValueError as error:
        raise CommandFailed.from_error(error) from None
    screen.print(f"{weights}, {card}", highlight=False)


def prepare_torch() -> None:
    """Prepare torch for training on one core.

    Raises:
        CommandFailed: torch is not installed.
    """
    try:
        import torch
    except ImportError:
        raise CommandFailed("train.no-torch", "training needs torch: pip install 'timberhand[train]'") from None
    torch.set_num_threads(1)
