"""``timberhand train``: the networks' weights from data, with a card that says how they were made."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode

if TYPE_CHECKING:
    from rich.console import Console

app = typer.Typer(no_args_is_help=True, help="Train a network and write its weights with a model card.")

Out = Annotated[Path, typer.Option(help="The weights; the card goes beside them as .md.")]
Seed = Annotated[int, typer.Option(help="Same seed and computer, same weights.")]
Pictures = Annotated[int, typer.Option(min=1, help="How many pictures are drawn; 0.6 MB each.")]
Rate = Annotated[float, typer.Option(min=1e-6, max=0.1, help="Greatest learning rate.")]
Large = Annotated[int, typer.Option(min=0, help="Pictures of twice the size, for half of what is learnt; 2.5 MB each.")]
Folder = Annotated[Path | None, typer.Option(help="Where they are kept (default: ~/.cache/timberhand/pictures).")]


class Labels(StrEnum):
    """What the grasp network learns from."""

    CORNELL = "cornell"
    PHYSICAL = "physical"


@app.command()
def grasp(
    data: Annotated[
        Path | None, typer.Option(help="Folder of Cornell samples: pcdNNNNd.tiff beside pcdNNNNcpos.txt.")
    ] = None,
    labels: Annotated[
        Labels, typer.Option(help="Rectangles of Cornell samples, or a physical rule on settled piles of logs.")
    ] = Labels.CORNELL,
    out: Annotated[Path | None, typer.Option(help="The weights; the card goes beside them as .md.")] = None,
    seed: Seed = 1,
    epochs: Annotated[
        int | None, typer.Option(min=1, help="Passes over all views (default: the shipped ones).")
    ] = None,
) -> None:
    """Train paper A's grasp network on Cornell samples or on drawn piles of logs, on one core.

    Ctrl-C keeps what was learnt; the same command goes on from there.

    [bold]Examples[/bold]

      timberhand train grasp --data ~/cornell

      timberhand train grasp --data ~/cornell --epochs 30 --out better.safetensors

      timberhand train grasp --labels physical     no data needed: piles are settled and labelled first

      timberhand experiment grasp-network --data ~/other_cornell     how good the shipped weights are there
    """
    torch_on_one_thread()
    weights = out or Path(f"grasp_{labels.value}.safetensors")
    if labels is Labels.PHYSICAL:
        if data is not None:
            raise CommandFailed(
                "train.data-not-wanted", "--data goes with --labels cornell; physical labels need none", ExitCode.USAGE
            )
        _grasp_physical(weights, seed, epochs)
    elif data is None:
        raise CommandFailed(
            "train.data-missing",
            "--data is missing: the folder of Cornell samples, or --labels physical without any",
            ExitCode.USAGE,
        )
    else:
        _grasp_cornell(data, weights, seed, epochs)


def _grasp_physical(weights: Path, seed: int, epochs: int | None) -> None:
    from training.grasp import physical_weights

    passes = epochs or physical_weights.EPOCHS
    _made(weights, None, lambda _, screen: physical_weights.produce(seed, weights, screen, epochs=passes)[1])


def _grasp_cornell(data: Path, out: Path, seed: int, epochs: int | None) -> None:
    from rich.console import Console

    from training.common.dataset_error import DatasetError
    from training.grasp import network_training as training
    from training.grasp.cornell import load
    from training.grasp.cornell_weights import produce

    screen = Console(stderr=True)
    try:
        samples = load(data)
    except DatasetError as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    try:
        weights, card = produce(samples, seed, epochs or training.EPOCHS, out, screen)
    except KeyboardInterrupt:
        raise CommandFailed(
            "train.interrupted", "interrupted; the same command goes on from the last checkpoint", ExitCode.INTERRUPTED
        ) from None
    screen.print(f"{weights}, {card}", highlight=False)


@app.command()
def segmentation(
    variant: Annotated[str, typer.Option(help="What the network sees: rgbd or depth.")] = "rgbd",
    out: Annotated[Path | None, typer.Option(help="The weights; the card goes beside them as .md.")] = None,
    seed: Seed = 1,
    steps: Annotated[int, typer.Option(min=1, help="Batches to learn from.")] = 6000,
    pictures: Pictures = 25_088,
    folder: Folder = None,
    learning_rate: Rate = 3e-3,
    start: Annotated[
        Path | None, typer.Option(help="Weights to go on from, for depth also those of rgbd (default: from scratch).")
    ] = None,
    large: Large = 0,
) -> None:
    """Train the network that finds logs, on pictures drawn for it, on one core.

    Piles are settled and pictures drawn first, and kept for the next time.  Ctrl-C keeps what was learnt; the same
    command goes on from there.

    [bold]Examples[/bold]

      timberhand train segmentation

      timberhand train segmentation --variant depth --steps 12000 --out logs_depth.safetensors

      timberhand train segmentation --pictures 256 --steps 50     a look at it in a few minutes
    """
    torch_on_one_thread()
    from autonomy.perception.segmentation.network import CHANNELS
    from training.detection.detector_weights import Plan, produce

    if variant not in CHANNELS:
        raise CommandFailed(
            "train.unknown-variant", f"variant {variant!r} is unknown; use one of {', '.join(CHANNELS)}", ExitCode.USAGE
        )
    weights = out or Path(f"logs_{variant}.safetensors")
    plan = Plan(pictures, steps, seed, learning_rate, start, large)
    _made(weights, folder, lambda kept, screen: produce(variant, plan, kept, weights, screen))


@app.command()
def detector(
    out: Out = Path("log_boxes.safetensors"),
    seed: Seed = 1,
    steps: Annotated[int, typer.Option(min=1, help="Batches to learn from.")] = 4000,
    pictures: Pictures = 25_088,
    folder: Folder = None,
    learning_rate: Rate = 3e-3,
    large: Large = 0,
    start: Annotated[Path | None, typer.Option(help="Weights to go on from (default: from scratch).")] = None,
) -> None:
    """Train paper B's detector in its role, boxes of logs from colour, on pictures drawn for it, on one core.

    The pictures are those of [bold]train segmentation[/bold].  Ctrl-C keeps what was learnt; the same command goes on
    from there.

    [bold]Examples[/bold]

      timberhand train detector

      timberhand train detector --pictures 256 --steps 50     a look at it in a few minutes
    """
    torch_on_one_thread()
    from training.detection.detector_weights import Plan, produce_boxes

    plan = Plan(pictures, steps, seed, learning_rate, start, large)
    _made(out, folder, lambda kept, screen: produce_boxes(plan, kept, out, screen))


@app.command()
def judges(
    out: Annotated[Path, typer.Option(help="Folder for joins and worth, .safetensors and .md.")] = Path(),
    seed: Seed = 1,
    pictures: Annotated[int, typer.Option(min=2, help="How many pictures are drawn; 2.5 MB each.")] = 1024,
    folder: Folder = None,
    weights: Annotated[
        Path | None, typer.Option(help="Of the network that looks at them (default: the shipped one).")
    ] = None,
) -> None:
    """Train the judges that say which pieces of a picture are one log, and how well a region fits one.

    They learn from what the network of [bold]train segmentation[/bold] sees: train them again after it.

    [bold]Examples[/bold]

      timberhand train judges

      timberhand train judges --pictures 64     a look at it in a minute
    """
    torch_on_one_thread()
    from training.detection.scorer_weights import produce

    _made(out, folder, lambda kept, screen: produce(pictures, seed, kept, out, weights, screen))


def _made(weights: Path, folder: Path | None, make: Callable[[Path, Console], Path]) -> None:
    """Make weights of drawn pictures and say where they are."""
    from rich.console import Console

    from training.pictures.piles import cache_folder

    screen = Console(stderr=True)
    try:
        card = make(folder or cache_folder().parent / "pictures", screen)
    except KeyboardInterrupt:
        raise CommandFailed(
            "train.interrupted", "interrupted; the same command goes on from the last checkpoint", ExitCode.INTERRUPTED
        ) from None
    except ValueError as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    screen.print(f"{weights}, {card}", highlight=False)


def torch_on_one_thread() -> None:
    """Ready torch for training here.

    Raises:
        CommandFailed: torch is not installed.
    """
    try:
        import torch
    except ImportError:
        raise CommandFailed(
            "train.no-torch", "training needs torch: pip install 'timberhand[train]'", ExitCode.CONFIGURATION
        ) from None
    torch.set_num_threads(1)
