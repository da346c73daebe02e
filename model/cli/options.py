"""What the commands share."""

from model.errors import ModelError
from model.training.trainer import NonFiniteLossError, TrainingStopped
from shards.commands.plain_errors import plain_errors as plain_errors_of
from shards.errors import ShardError
from shards.settings import SettingsError

__all__ = ["plain_errors"]

USER_ERRORS = (SettingsError, ModelError, ShardError, NonFiniteLossError)
STOPPED = 143  # as a process that SIGTERM ended; here after saving

plain_errors = plain_errors_of("forehoi", dict.fromkeys(USER_ERRORS, 2) | {TrainingStopped: STOPPED})
