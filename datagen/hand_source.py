"""From the `hand` section of a configuration to a hand model and its skin: open, or licensed when there."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from datagen.hands.html_skin import load_html_skin
from datagen.hands.mano import find_mano, load_mano
from datagen.hands.model import HandModel, load_open_hand, mirror_hand
from datagen.hands.skin import SkinBasis, load_open_skin
from datagen.input_error import InputError

__all__ = ["HandConfig", "HandSource", "html_dir", "mano_dir", "open_hand", "resolved_hand"]

HTML_MODEL = Path("TextureBasis") / "model_sr" / "model.pkl"


@dataclass(frozen=True, kw_only=True)
class HandConfig:
    """Which hand is drawn. `auto` takes the licensed model when its files are there, else the open one."""

    model: Literal["open", "mano", "auto"]
    mano_dir: Path | None  # folder of MANO_RIGHT.pkl; null: $MANO_DIR
    skin: Literal["open", "html", "auto"]
    html_dir: Path | None  # folder of TextureBasis; null: $HTML_DIR
    left_probability: float  # of a motion with a left hand: the mirror image of a right one

    def __post_init__(self) -> None:
        if not 0.0 <= self.left_probability <= 1.0:
            raise ValueError(f"left_probability is {self.left_probability}: expected 0..1")
        if self.model == "open" and self.skin == "html":
            raise ValueError(
                "skin is html with model open: the HTML texture is laid out on MANO's triangles; "
                "expected model: mano (or auto), or skin: open"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class HandSource:
    """The right hand with UVs of its skin, and the skin. Left hands are its mirror image."""

    right: HandModel
    skins: SkinBasis

    def model(self, side: Literal["right", "left"]) -> HandModel:
        """The hand of one side; a mirrored motion of it is the exact mirror image."""
        return self.right if side == "right" else mirror_hand(self.right)


def mano_dir(config: HandConfig) -> Path | None:
    """Where MANO should lie: the configuration, else $MANO_DIR, else nowhere."""
    return config.mano_dir or _from_environment("MANO_DIR")


def html_dir(config: HandConfig) -> Path | None:
    """Where the HTML texture model should lie: the configuration, else $HTML_DIR, else nowhere."""
    return config.html_dir or _from_environment("HTML_DIR")


def resolved_hand(config: HandConfig) -> HandConfig:
    """`auto` decided by what is on this machine, so that what was used is part of the configuration."""
    model, skin = config.model, config.skin
    if model == "auto":
        folder = mano_dir(config)
        model = "mano" if folder is not None and find_mano(folder, "right") is not None else "open"
    if skin == "auto":
        folder = html_dir(config)
        there = folder is not None and (folder / HTML_MODEL).is_file()
        skin = "html" if model == "mano" and there else "open"
    return replace(config, model=model, skin=skin)


def open_hand(config: HandConfig) -> HandSource:
    """Load the hand that `config` names; `auto` must have been resolved. InputError names what is missing."""
    if "auto" in (config.model, config.skin):
        raise ValueError("hand.model or hand.skin is still auto: call resolved_hand first")
    if config.model == "open":
        return HandSource(right=load_open_hand(), skins=load_open_skin())
    model = load_mano(_required(mano_dir(config), "hand.mano_dir", "MANO_DIR", "MANO_RIGHT.pkl"), "right")
    skins = load_open_skin()
    if config.skin == "html":
        folder = _required(html_dir(config), "hand.html_dir", "HTML_DIR", "TextureBasis")
        html = load_html_skin(folder, model)
        model, skins = replace(model, corner_uv=html.corner_uv), html.basis
    return HandSource(right=model, skins=skins)


def _required(folder: Path | None, key: str, variable: str, content: str) -> Path:
    if folder is None:
        raise InputError(
            key,
            f"is null and {variable} is not set",
            expected=f"the folder that holds {content}",
            action="Set one of them; `datagen assets` tells where to get the files.",
        )
    return folder


def _from_environment(variable: str) -> Path | None:
    value = os.environ.get(variable, "")
    return Path(value).expanduser() if value else None
