"""What generated code can call by name, beside what the engine binds for its targets."""

from __future__ import annotations

from collections.abc import Mapping

from router.compiler.cdr.readers import cut_off, numbers, refuse, text, texts, wide_text, wide_texts
from router.compiler.cdr.steps import CDR_LE, HEADER
from router.compiler.cdr.writers import put_length, put_numbers, put_text, put_wide_text, want_length
from router.compiler.functions import FUNCTIONS
from router.compiler.implementations import entries, fit, fit_length, fit_text, fit_wide_text

NAMESPACE: Mapping[str, object] = {
    **{name: function.implementation for name, function in FUNCTIONS.items()},
    "entries": entries,
    "fit": fit,
    "fit_length": fit_length,
    "fit_text": fit_text,
    "fit_wide_text": fit_wide_text,
    "HEADER": HEADER,
    "CDR_LE": CDR_LE,
    "ZERO": b"\0",
    "put_text": put_text,
    "put_wide_text": put_wide_text,
    "put_numbers": put_numbers,
    "put_length": put_length,
    "want_length": want_length,
    "refuse": refuse,
    "cut_off": cut_off,
    "text": text,
    "texts": texts,
    "wide_text": wide_text,
    "wide_texts": wide_texts,
    "numbers": numbers,
}
