"""The column tables of README.md, made from the schema.

`python -m shards.column_tables` prints them; with a path it updates them inside that file.
"""

import sys
from pathlib import Path

from shards.columns import markdown_table
from shards.schema import ROW_TYPES

__all__ = ["readme_tables", "update_readme"]

_BEGIN, _END = (
    "<!-- columns: python -m shards.column_tables shards/README.md -->\n",
    "<!-- end of columns -->\n",
)


def readme_tables() -> str:
    """The column tables of the three files, as they stand in README.md."""
    parts = [
        f"### {name}.parquet\n\n{(row_type.__doc__ or '').strip()}\n\n{markdown_table(row_type)}\n"
        for name, row_type in ROW_TYPES.items()
    ]
    return "\n".join(parts)


def update_readme(text: str) -> str:
    """`text` with the block between the two markers replaced by the current tables."""
    before, rest = text.split(_BEGIN)
    after = rest.split(_END)[1]
    return f"{before}{_BEGIN}\n{readme_tables()}\n{_END}{after}"


if __name__ == "__main__":
    if len(sys.argv) == 1:
        sys.stdout.write(readme_tables())
    else:
        readme = Path(sys.argv[1])
        readme.write_text(update_readme(readme.read_text(encoding="utf-8")), encoding="utf-8")
