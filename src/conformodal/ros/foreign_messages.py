"""Messages of another library (rosbags, rclpy) from plain ones."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from .messages import RosMessage


def build(
    value: Any, class_of: Callable[[str], Any], sequence: Callable[[array[Any]], Any] = lambda found: found
) -> Any:
    """A message of another library, with all messages in it.

    Parameters
    ----------
    value
        A :class:`RosMessage`, or what one of its fields holds.
    class_of
        Gives that library's class for the name of a type.
    sequence
        Makes of an :class:`array.array` what that library takes.
    """
    if isinstance(value, RosMessage):
        made = {f.name: build(getattr(value, f.name), class_of, sequence) for f in fields(value)}
        return class_of(value.TYPE)(**made)
    if isinstance(value, list):
        return [build(item, class_of, sequence) for item in value]
    return sequence(value) if isinstance(value, array) else value
