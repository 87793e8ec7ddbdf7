"""The carrier: a C library that receives, forwards and brakes, and its Python interface."""
