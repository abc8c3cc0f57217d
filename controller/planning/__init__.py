"""From a target to the segments of the reference."""

STREAM_TARGET = "stream"
"""The name of a target that is streamed, alone or with the address to listen at, such as stream:127.0.0.1:47200."""
