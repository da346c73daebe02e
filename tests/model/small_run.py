"""The preset tiny with a hand encoder, cut down to seconds: two steps of each component, on balls."""

import re
from pathlib import Path
from typing import Any

import yaml
from click.testing import CliRunner

from model.cli.main import main
from model.recipes.config import read_settings

ROOT = Path(__file__).resolve().parents[2]
STEPS = 2


def small_settings(dataset: Path) -> dict[str, Any]:
    """The content of the file, to be changed further."""
    config = read_settings("tiny").data
    config["hand_encoder"] = read_settings("hands").data["hand_encoder"]
    config["encoders"] |= {"image": {"image_size": 64, "grid": 8}, "hand": {"own_grid": 8}}
    config["stage_one"]["network"]["masks"]["grid"] = 8
    config["data"] |= {
        "datasets": [str(dataset)],
        "workers": 0,
        "samples_per_motion": 4,
        "held_out_cameras": 0.4,
    }
    config["validation"] |= {"views": 2, "batch_size": 2, "batches": 1}
    config["stage_one"]["sampler"]["steps"] = 2
    for component in ("vae", "hand_encoder", "stage_one"):
        recipe = config[component]["recipe"]
        recipe |= {"batch_size": 2} if component == "vae" else {"batch_size": 2, "views": [1, 2]}
        recipe["trainer"] |= {
            "steps": STEPS,
            "precision": "float32",  # the same on every machine, and fast on every one
            "checkpoint_every": 1,
            "keep_checkpoints": 2,
            "validate_every": STEPS,
            "log_every": 1,
        }
    return config


def write_config(path: Path, settings: dict[str, Any]) -> Path:
    path.write_text(yaml.safe_dump(settings))
    return path


def forehoi(*arguments: object) -> tuple[int, str]:
    """Exit status and output of the command; an exception that is no exit is a bug and is raised."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def fails(*arguments: object) -> str:
    """The one line of a command that ends with status 2."""
    status, output = forehoi(*arguments)
    assert status == 2, output
    *progress, line = output.strip().splitlines()
    assert line.startswith("forehoi: "), output
    assert all(re.match(r"(vae|hand_encoder|stage_one|slat_vae|slat_flow): ", said) for said in progress), (
        output
    )
    return line
