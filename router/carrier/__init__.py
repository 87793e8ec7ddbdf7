"""The carrier: a C library that receives, forwards and brakes, and the threads of Python that it works with."""
