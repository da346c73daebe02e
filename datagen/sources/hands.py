"""From the `hand` section of a configuration to a hand model and its skin: open, or licensed when there."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from datagen.hands.html_skin import find_html, load_html_skin
from datagen.hands.mano import find_mano, load_mano
from datagen.hands.model import HandModel, load_open_hand, mirror_hand
from datagen.hands.skin import SkinBasis, load_open_skin
from datagen.input_error import InputError
from shards.settings import Range

__all__ = ["HandConfig", "HandSource", "html_dir", "mano_dir", "open_hand", "resolved_hand"]


@dataclass(frozen=True, kw_only=True)
class HandConfig:
    """Which hand is drawn. `auto` takes the licensed model when its files are there, else the open one."""

    model: Literal["open", "mano", "auto"]
    mano_dir: Path | None  # folder of MANO_RIGHT.pkl; null: $MANO_DIR
    skin: Literal["open", "html", "auto"]
    html_dir: Path | None  # folder of TextureBasis; null: $HTML_DIR
    # of a motion with a left hand: the mirror image of a right one
    left_probability: Annotated[float, Range(0, 1)]

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
    return _place(config.mano_dir, "MANO_DIR")


def html_dir(config: HandConfig) -> Path | None:
    """Where the HTML texture model should lie: the configuration, else $HTML_DIR, else nowhere."""
    return _place(config.html_dir, "HTML_DIR")


def resolved_hand(config: HandConfig) -> HandConfig:
    """`auto` decided by what is on this machine, so that what was used is part of the configuration.

    A place that is named but does not hold the files is an InputError, not a reason to take the
    open hand.
    """
    model, skin = config.model, config.skin
    hands, textures = mano_dir(config), html_dir(config)
    if model == "auto":
        model = "open" if hands is None else "mano"
        if hands is not None and find_mano(hands, "right") is None:
            raise _lacks(hands, "hand.mano_dir (or MANO_DIR)", "MANO_RIGHT.pkl")
    if skin == "html" and model == "open":
        raise InputError(
            "hand.skin",
            "is html, but there is no MANO, on whose triangles that texture lies",
            expected="hand.mano_dir or MANO_DIR to name the folder of MANO_RIGHT.pkl",
            action="Set it, or choose hand.skin: open; `datagen assets` tells where to get the files.",
        )
    if skin == "auto":
        skin = "html" if model == "mano" and textures is not None else "open"
        if skin == "html" and textures is not None and find_html(textures) is None:
            raise _lacks(textures, "hand.html_dir (or HTML_DIR)", "TextureBasis/model_sr/model.pkl")
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


def _lacks(folder: Path, setting: str, content: str) -> InputError:
    return InputError(
        folder,
        f"holds no {content}, though {setting} names it",
        expected=f"a folder with {content}",
        action="Correct the place, or take the setting away to use the open hand.",
    )


def _place(path: Path | None, variable: str) -> Path | None:
    """`path`, else what the environment variable says, with ~ expanded."""
    named = str(path) if path is not None else os.environ.get(variable, "")
    return Path(named).expanduser() if named else None
