"""Requests that two programs on the way could read differently, of public lists, and how they are rejected."""

from __future__ import annotations

import pytest

from router.observe.requests import BadRequestError, parse

GET = b"GET / HTTP/1.1\r\nHost: rover\r\n"


@pytest.mark.parametrize(
    ("target", "path", "query", "host"),
    [
        (b"/", "/", "", "rover"),
        (b"/tap?case=imu_info", "/tap", "case=imu_info", "rover"),
        (b"http://192.168.0.5:9108/metrics?x", "/metrics", "x", "192.168.0.5:9108"),
        (b"HTTP://other", "/", "", "other"),
        (b"http://other?x=1", "/", "x=1", "other"),
        (b"//other/metrics", "//other/metrics", "", "rover"),
    ],
)
def test_target_is_a_path_or_a_whole_url_whose_host_counts(target: bytes, path: str, query: str, host: str) -> None:
    request = parse(b"GET " + target + b" HTTP/1.1\r\nHost: rover\r\n\r\n")
    assert (request.method, request.path, request.query, request.host) == ("GET", path, query, host)


def test_headers_are_found_by_any_case_and_without_spaces_around() -> None:
    request = parse(GET + b"aCCept: \t a b\t \r\nAccept:c\r\nEmpty:\r\n\r\n")
    assert (request.header("accept"), request.headers["empty"], request.header("none", "-")) == ("a b, c", [""], "-")


@pytest.mark.parametrize(
    ("head", "is_last"),
    [
        (GET + b"\r\n", False),
        (GET + b"Connection: keep-alive\r\n\r\n", False),
        (GET + b"Connection: TE, Close\r\n\r\n", True),
        (b"GET / HTTP/1.0\r\n\r\n", True),
        (b"GET / HTTP/1.0\r\nConnection: keep-alive\r\n\r\n", True),
        (GET + b"Content-Length: 0\r\n\r\n", False),
    ],
)
def test_connection_ends_when_the_client_wants_it(head: bytes, is_last: bool) -> None:
    assert parse(head).is_last == is_last


AMBIGUOUS = {
    # the length of the body
    "a body": GET + b"Content-Length: 44\r\n\r\n",
    "CL.CL": GET + b"Content-Length: 0\r\nContent-Length: 44\r\n\r\n",
    "CL.CL, equal": GET + b"Content-Length: 0\r\nContent-Length: 0\r\n\r\n",
    "CL list": GET + b"Content-Length: 0, 44\r\n\r\n",
    "CL with a sign": GET + b"Content-Length: +0\r\n\r\n",
    "CL in hex": GET + b"Content-Length: 0x0\r\n\r\n",
    "CL below zero": GET + b"Content-Length: -1\r\n\r\n",
    "CL with zeros": GET + b"Content-Length: 00\r\n\r\n",
    "CL empty": GET + b"Content-Length:\r\n\r\n",
    "CL.TE": GET + b"Content-Length: 44\r\nTransfer-Encoding: chunked\r\n\r\n",
    "TE.CL": GET + b"Transfer-Encoding: chunked\r\nContent-Length: 0\r\n\r\n",
    "TE": GET + b"Transfer-Encoding: chunked\r\n\r\n",
    "TE.TE": GET + b"Transfer-Encoding: chunked\r\nTransfer-Encoding: x\r\n\r\n",
    "TE xchunked": GET + b"Transfer-Encoding: xchunked\r\n\r\n",
    "TE identity": GET + b"Transfer-Encoding: identity\r\n\r\n",
    "TE quoted": GET + b'Transfer-Encoding: "chunked"\r\n\r\n',
    "TE in HTTP/1.0": b"GET / HTTP/1.0\r\nTransfer-Encoding: chunked\r\n\r\n",
    # lines
    "space before the colon": GET + b"Transfer-Encoding : chunked\r\n\r\n",
    "tab before the colon": GET + b"Content-Length\t: 44\r\n\r\n",
    "folded value": GET + b"Transfer-Encoding:\r\n chunked\r\n\r\n",
    "folded line": GET + b"X: y\r\n Content-Length: 44\r\n\r\n",
    "space before the first header": b"GET / HTTP/1.1\r\n Host: rover\r\n\r\n",
    "lone LF between lines": GET + b"X: y\nContent-Length: 44\r\n\r\n",
    "lone LF at the end": GET + b"X: y\r\n\n",
    "LF only": b"GET / HTTP/1.1\nHost: rover\n\n",
    "lone CR": GET + b"X: y\rContent-Length: 44\r\n\r\n",
    "NUL": GET + b"X: y\0\r\n\r\n",
    "vertical tab before a name": GET + b"\x0bTransfer-Encoding: chunked\r\n\r\n",
    "vertical tab in a value": GET + b"Transfer-Encoding: \x0bchunked\r\n\r\n",
    "no colon": GET + b"Content-Length 44\r\n\r\n",
    "no name": GET + b": 44\r\n\r\n",
    "name in quotes": GET + b'"Content-Length": 44\r\n\r\n',
    # the first line
    "no version": b"GET /\r\nHost: rover\r\n\r\n",
    "two spaces": b"GET  / HTTP/1.1\r\nHost: rover\r\n\r\n",
    "tab": b"GET\t/\tHTTP/1.1\r\nHost: rover\r\n\r\n",
    "space at the end": b"GET / HTTP/1.1 \r\nHost: rover\r\n\r\n",
    "version in small letters": b"GET / http/1.1\r\nHost: rover\r\n\r\n",
    "version of three digits": b"GET / HTTP/1.10\r\nHost: rover\r\n\r\n",
    "method in small letters": b"get / HTTP/1.1\r\nHost: rover\r\n\r\n",
    "space in the path": b"GET /a b HTTP/1.1\r\nHost: rover\r\n\r\n",
    "fragment": b"GET /#x HTTP/1.1\r\nHost: rover\r\n\r\n",
    "no path": b"GET rover HTTP/1.1\r\nHost: rover\r\n\r\n",
    "user in the URL": b"GET http://a@b/ HTTP/1.1\r\nHost: rover\r\n\r\n",
    # the host
    "no host": b"GET / HTTP/1.1\r\n\r\n",
    "two hosts": GET + b"Host: other\r\n\r\n",
    "host list": b"GET / HTTP/1.1\r\nHost: rover, other\r\n\r\n",
    "host with a path": b"GET / HTTP/1.1\r\nHost: rover/x\r\n\r\n",
    "host in a URL": b"GET http://a:b:c/ HTTP/1.1\r\nHost: rover\r\n\r\n",
}


@pytest.mark.parametrize("head", AMBIGUOUS.values(), ids=AMBIGUOUS)
def test_what_two_programs_could_read_differently_is_rejected(head: bytes) -> None:
    with pytest.raises(BadRequestError) as rejected:
        parse(head)
    assert rejected.value.status == 400


def test_only_http_1_is_spoken() -> None:
    with pytest.raises(BadRequestError) as rejected:
        parse(b"PRI * HTTP/2.0\r\n\r\n")
    assert rejected.value.status == 505
