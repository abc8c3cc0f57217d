"""From a target to the segments of the reference."""

STREAM_TARGET = "stream"
"""The name of a target that is streamed, alone or with the address to listen at, such as stream:127.0.0.1:47200."""

OPERATOR_TARGET = "operator"
"""The name of a target that an operator moves while the loop runs, alone or with the address of the operator's channel."""
