"""`forehoi` and `python -m model`."""

from shards.commands.extras import needs_extra

__all__ = ["main"]


def main() -> None:
    """Run the command, or say which extra is not installed; nothing of it is imported before."""
    with needs_extra("forehoi", "model", make="train"):
        from model.cli.main import main as command

        command()


if __name__ == "__main__":
    main()
