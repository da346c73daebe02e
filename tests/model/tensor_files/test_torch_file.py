"""Files of torch.save: tensors are read, and nothing that a file names is run."""

import contextlib
import os
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path

import pytest
import torch
from torch import nn

from model.errors import ModelError
from model.tensor_files.torch_file import read_torch_tensors


def read(path: Path) -> dict[str, torch.Tensor]:
    return read_torch_tensors(path, expected="weights", action="Do something.")


def fails(path: Path, *parts: str) -> None:
    with pytest.raises(ModelError) as caught:
        read(path)
    text = str(caught.value)
    assert "\n" not in text
    assert "weights_only" not in text  # torch's own message says how to run the file's code
    assert all(part in text for part in parts), text


@pytest.mark.parametrize("is_zip", [True, False])
def test_a_state_dict_is_read_as_it_was_saved(tmp_path: Path, is_zip: bool) -> None:
    module = nn.Linear(3, 2)
    state = module.state_dict() | {"half": torch.ones(2).half(), "view": torch.arange(6.0).view(2, 3).T}
    state["bias"] = module.bias  # TRELLIS saves parameters
    for content in (state, OrderedDict(state), {"state_dict": state, "step": 3}, {"model": state, "ema": {}}):
        torch.save(content, tmp_path / "a.pt", _use_new_zipfile_serialization=is_zip)
        found = read(tmp_path / "a.pt")
        assert found.keys() == state.keys()
        for name, tensor in found.items():
            assert torch.equal(tensor, state[name].detach())
            assert tensor.dtype == state[name].dtype
            assert not tensor.requires_grad


class Payload:
    """Unpickled without restriction it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("is_zip", [True, False])
def test_nothing_that_a_file_names_is_run(tmp_path: Path, is_zip: bool) -> None:
    made = tmp_path / "made"
    content = {"a": torch.ones(1), "b": Payload(made)}
    torch.save(content, tmp_path / "a.pt", _use_new_zipfile_serialization=is_zip)
    fails(tmp_path / "a.pt", "names posix.mkdir, and nothing but tensors is read")
    assert not made.exists()
    torch.load(tmp_path / "a.pt", weights_only=False)
    assert made.exists()  # the payload works


def test_what_is_no_state_dict_is_refused_by_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    for content, part in [
        (torch.ones(2), "holds a tensor (torch.strided), not named tensors"),
        ([torch.ones(2)], "holds a value of type list, not named tensors"),
        ({}, "holds an empty dict, not named tensors"),
        ({"optimizer": {"state": {}}, "step": 7}, "holds a value of type dict under 'optimizer'"),
        ({"a": torch.ones(2), "step": 7}, "holds a value of type int under 'step'"),
        ({3: torch.ones(2)}, "holds a tensor (torch.strided) under 3"),
        ({"a": torch.ones(2).to_sparse()}, "holds a tensor (torch.sparse_coo) under 'a'"),
        ({"a": torch.ones(2, dtype=torch.float64)}, "stores a as F64"),
        ({"a": torch.ones(2, dtype=torch.int8)}, "stores a as torch.int8"),
        (nn.Linear(2, 2), "names torch.nn.modules.linear.Linear"),
    ]:
        torch.save(content, path)
        fails(path, part)


def test_files_that_are_none_or_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save({"a": torch.ones(1000)}, path)
    whole = path.read_bytes()
    for n_bytes in (0, 3, 64, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:n_bytes])
        fails(path, "expected weights")
    path.write_bytes(whole[:64])
    fails(path, "cut off after 64 bytes: an interrupted download")
    for position in range(0, len(whole), 97):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0xFF]) + whole[position + 1 :])
        with contextlib.suppress(ModelError):  # anything else would be a traceback
            assert read(path)["a"].shape == (1000,)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    fails(path, "Git LFS pointer", "git lfs pull")
    path.write_bytes(pickle.dumps({"a": 1}))
    fails(path, "expected weights")
    torch.jit.script(nn.Linear(2, 2)).save(path)
    fails(path, "is a TorchScript program")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x/data.pkl", pickle.dumps({"a": 1}))
    fails(path, "expected weights")
