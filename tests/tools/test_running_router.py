"""What tools ask of a running router over HTTP, and what they say where there is none."""

from __future__ import annotations

import pytest

from router.errors import UsageError
from router.observe.snapshot import Snapshot
from router.tools.running_router import metrics
from tests.tools.answering import COLLECTED_AT, answering


def test_metrics_are_asked_for_at_the_router_and_no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    found = Snapshot(COLLECTED_AT, {"kernel_drops": {("rover",): 3.0}})
    with answering('router_kernel_drops_total{listener="rover"} 3\n') as url:
        assert metrics(url) == metrics(url.removeprefix("http://")) == found


@pytest.mark.parametrize(
    "url",
    [
        "https://127.0.0.1:9108",
        "http://",
        "ftp://rover",
        "http://a:99999",
        "a:port",
        "http://a b:1",
        "http://[::1",
        "http://[fd00::zz]:9108",
        "http://rover..local",
        f"http://{'a' * 64}:9108",
    ],
)
def test_what_is_no_address_of_a_router_is_a_wrong_use(url: str) -> None:
    with pytest.raises(UsageError) as refused:
        metrics(url)
    assert str(refused.value) == f"'{url}' is not like http://127.0.0.1:9108"
