"""Classes of ROS messages are found by their names, which may come from anybody."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.errors import StartError
from router.ros.types import installed_class

ACTION = """\
class Wait_Feedback:
    def get_fields_and_field_types(): ...

class Wait:
    Feedback = Wait_Feedback

class Other: ...
"""
"""What rosidl generates for an action, as far as it matters here."""

Write = Callable[[str, str], None]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Write]:
    """Writes a module, which can be imported until the test is over."""
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)

    def written(path: str, text: str) -> None:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
        importlib.invalidate_caches()

    yield written
    for name in set(sys.modules) - before:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("std_msgs/msg/String", "std_msgs.msg._string"),
        ("rcl_interfaces/srv/GetParameters_Event", "rcl_interfaces.srv._get_parameters"),
        ("lifecycle_msgs/srv/GetState_Request", "lifecycle_msgs.srv._get_state"),
    ],
)
def test_a_message_or_a_part_of_a_service_is_found(name: str, module: str) -> None:
    found = installed_class(name)
    assert (found.__module__, found.__name__) == (module, name.rpartition("/")[2])


def test_a_part_of_an_action_is_found_which_its_package_does_not_show(write: Write) -> None:
    write("made_msgs/action/__init__.py", "from made_msgs.action._wait import Wait")
    write("made_msgs/action/_wait.py", ACTION)
    assert installed_class("made_msgs/action/Wait_Feedback").__name__ == "Wait_Feedback"
    for name in ("made_msgs/action/Wait", "made_msgs/action/Wait_Goal", "made_msgs/action/Other"):
        with pytest.raises(StartError, match=f"{name} is not installed .'made_msgs.action' has no such message"):
            installed_class(name)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("std_msgs/msg/NoSuch", r"'std_msgs\.msg' has no such message\); run 'make setup'"),
        ("no_such_msgs/msg/Thing", r"there is no Python package 'no_such_msgs\.msg'\); run 'make setup'"),
        ("std_msgs/action/Wait_Feedback", r"there is no Python package 'std_msgs\.action'"),
        ("rcl_interfaces/srv/GetParameters", r"'rcl_interfaces\.srv' has no such message"),
        ("std_msgs/msg/_string", "it is no name of a ROS message"),
        ("some::Idl_", "it is no name of a ROS message"),
        ("os/path/Join", "it is no name of a ROS message"),
        ("a.b/msg/C", "it is no name of a ROS message"),
        ("__main__/msg/C", "it is no name of a ROS message"),
    ],
)
def test_what_is_not_installed_is_refused(name: str, why: str) -> None:
    with pytest.raises(StartError, match=rf"^{name} is not installed \({why}"):
        installed_class(name)


@pytest.mark.parametrize("module", ["innocent.py", "innocent/__init__.py"])
def test_nothing_is_imported_that_has_no_messages(write: Write, module: str) -> None:
    write(module, "raise AssertionError('imported because somebody on the network said so')")
    with pytest.raises(StartError, match=r"no Python package 'innocent\.msg'"):
        installed_class("innocent/msg/Thing")


def test_a_package_that_cannot_be_imported_says_why(write: Write) -> None:
    write("broken_msgs/msg/__init__.py", "import no_such_module")
    with pytest.raises(StartError, match=r"^broken_msgs/msg/A cannot be loaded: No module named 'no_such_module'"):
        installed_class("broken_msgs/msg/A")
