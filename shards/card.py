"""README.md of a dataset: the card that tells `datasets.load_dataset` which Parquet files make a table.

Without it every Parquet file of the folder, plan and selection among them, is taken for one table, which fails.
"""

from pathlib import Path

from shards.errors import storage_error
from shards.schema import ROW_TYPES
from shards.splits import SplitRule
from shards.storage.records import DatasetRecord
from shards.storage.whole_file import write_whole

__all__ = ["CARD_FILE", "card_text", "write_card"]

CARD_FILE = "README.md"
_DEFAULT_TABLE = "frames"
_UNDIVIDED = "all_splits"

_BODY = """
# {name}

A dataset of hands that hold objects, rendered with exact labels. Read it with the package `shards`, which checks every
byte and decodes the images; `shards/README.md` of its repository describes every column. dataset.json holds the
configuration that made it.

The tables of its finished shards also open as they are, images as bytes:

```python
from datasets import load_dataset

frames = load_dataset("path/to/dataset", "frames", split="{split}")  # also "clips" and "objects"
```
"""

_DIVIDE = """
Training, validation and test are divided by object (column `split` of `clips`), and a file may hold objects of each, so
the tables come undivided. One split of them:

```python
clips = load_dataset("path/to/dataset", "clips", split="{split}")
of_split = set(clips.filter(lambda split: split == "train", input_columns="split")["clip_id"])
frames = frames.filter(lambda clip_id: clip_id in of_split, input_columns="clip_id")
```
"""


def write_card(dataset_dir: Path, record: DatasetRecord) -> None:
    """Write README.md unless there is one, which may be the user's own. Raises StorageError."""
    path = dataset_dir / CARD_FILE
    if path.exists():
        return
    try:
        with write_whole(path, durable=True) as partial:
            partial.write_text(card_text(record), encoding="utf-8")
    except OSError as error:
        raise storage_error(error, path, doing="writing the card") from error


def card_text(record: DatasetRecord) -> str:
    """The card: one configuration for each table, with patterns that find shards as they are finished."""
    split = _only_split(record.split_rule)
    lines = ["---", "configs:"]
    for table in sorted(ROW_TYPES, key=lambda name: name != _DEFAULT_TABLE):
        lines += [f"- config_name: {table}"]
        lines += ["  default: true"] if table == _DEFAULT_TABLE else []
        lines += [
            "  data_files:",
            f"  - split: {split or _UNDIVIDED}",
            f"    path: shards/shard-*/{table}.parquet",
        ]
    body = _BODY if split else _BODY + _DIVIDE
    return "\n".join([*lines, "---", ""]) + body.format(name=record.name, split=split or _UNDIVIDED)


def _only_split(rule: SplitRule) -> str:
    """The split of all objects where the rule knows one alone; else empty."""
    train_fraction = 1.0 - rule.val_fraction - rule.test_fraction
    shares = {"train": train_fraction, "val": rule.val_fraction, "test": rule.test_fraction}
    present = [split for split, share in shares.items() if share > 0.0]
    return present[0] if len(present) == 1 else ""
