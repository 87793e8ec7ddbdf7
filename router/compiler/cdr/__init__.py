"""ROS messages as CDR bytes: generated code that writes them from a mapping's plan.

Plain CDR, little-endian (XCDR1, as Fast DDS and Cyclone DDS speak it): four bytes of header, then each
scalar aligned to its own size counted from behind the header. Up to the first string or sequence of
unknown length all offsets are known when the code is generated, so that one `struct` call does.
"""

from __future__ import annotations

from router.compiler.cdr.writing import message_size, write_message

__all__ = ["write_message", "message_size"]
