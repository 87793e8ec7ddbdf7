"""Installed ROS message types: classes are found by name, and describe the fields that their definitions declare."""

from __future__ import annotations

import importlib
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rosidl_parser.definition import (  # type: ignore[import-untyped]
    Array,
    BasicType,
    BoundedSequence,
    BoundedString,
    BoundedWString,
    NamespacedType,
    UnboundedSequence,
    UnboundedString,
    UnboundedWString,
)

from router.compiler.lookup import definitions_of
from router.errors import StartError
from router.ros import types as ros_types
from router.ros.types import installed_class, installed_type, loaded_class, usable_class
from router.types.model import Bool, Float, Int, List, MessageType, String, Type
from router.types.ros import ros_interfaces
from tests.compiler.interface_package import built, environment, is_buildable

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
        ("std_msgs/msg/_string", "it is not the name of a ROS message"),
        ("some::Idl_", "it is not the name of a ROS message"),
        ("os/path/Join", "it is not the name of a ROS message"),
        ("a.b/msg/C", "it is not the name of a ROS message"),
        ("__main__/msg/C", "it is not the name of a ROS message"),
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


def is_installed(name: str) -> bool:
    package, _, short = name.partition("/msg/")
    return find_spec(package) is not None and hasattr(__import__(f"{package}.msg").msg, short)


def generated(**slots: object) -> SimpleNamespace:
    """What stands for a class with these slots. How it spells them does not matter."""
    return SimpleNamespace(
        get_fields_and_field_types=lambda: dict.fromkeys(slots, ""), SLOT_TYPES=tuple(slots.values())
    )


def shape(declared: object) -> object:
    """The type with all that is in it, to be compared."""
    match declared:
        case MessageType():
            return declared.name, [(field.name, shape(field.type)) for field in declared.fields]
        case List():
            return shape(declared.element), declared.length, declared.bound
        case _:
            return declared


def test_a_class_describes_what_its_msg_file_declares() -> None:
    interfaces = ros_interfaces()
    names = sorted(filter(is_installed, interfaces.names()))
    assert len(names) > 50
    for name in names:
        declared, described = interfaces.get(name), installed_type(name)
        assert declared
        assert shape(described) == shape(declared), name
        assert definitions_of(described) == definitions_of(declared), name


def test_what_belongs_to_a_service_is_named_so_and_its_class_matches() -> None:
    event = installed_type("type_description_interfaces/srv/GetTypeDescription_Event")
    _, request, _ = event.fields
    assert (request.name, shape(request.type)) == (
        "request",
        (
            (
                "type_description_interfaces/srv/GetTypeDescription_Request",
                [("type_name", String()), ("type_hash", String()), ("include_type_sources", Bool())],
            ),
            None,
            1,
        ),
    )
    found = usable_class(event.name, definitions_of(event))
    assert found.__class__._TYPE_SUPPORT is loaded_class(event.name).__class__._TYPE_SUPPORT


def test_a_type_for_cdr_has_the_type_support_of_its_class() -> None:
    interfaces = ros_interfaces()
    for name in sorted(filter(is_installed, interfaces.names())):
        declared = interfaces.get(name)
        assert declared
        quick, loaded = usable_class(name, definitions_of(declared)), loaded_class(name)
        assert quick is not loaded, name
        assert quick.__class__._TYPE_SUPPORT is loaded.__class__._TYPE_SUPPORT, name
        assert (quick.__module__.split(".")[:2], quick.__name__) == (
            loaded.__module__.split(".")[:2],
            loaded.__name__,
        )


@pytest.mark.parametrize("other", [("data", "wstring"), ("date", "string")])
def test_a_type_that_is_installed_otherwise_is_refused(other: tuple[str, str]) -> None:
    with pytest.raises(StartError, match="the installed std_msgs/msg/String is not the one the table was compiled for"):
        usable_class("std_msgs/msg/String", {"std_msgs/msg/String": (other,)})


def test_a_type_with_another_one_in_it_that_is_installed_otherwise_is_refused() -> None:
    declared = ros_interfaces().get("sensor_msgs/msg/Imu")
    assert declared
    changed = {**definitions_of(declared), "std_msgs/msg/Header": (("frame_id", "string"),)}
    with pytest.raises(StartError, match=r"^the installed std_msgs/msg/Header is not the one"):
        usable_class(declared.name, changed)


def test_a_type_for_cdr_imports_no_class() -> None:
    code = (
        "import sys; from router.compiler.lookup import definitions_of; from router.types.ros import ros_interfaces\n"
        "from router.ros.node import open_node; from router.ros.types import usable_class; open_node('quick')\n"
        "imu = ros_interfaces().get('sensor_msgs/msg/Imu'); usable_class(imu.name, definitions_of(imu))\n"
        "print({'numpy', 'sensor_msgs.msg', 'geometry_msgs'} & sys.modules.keys())"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert child.stdout == "set()\n"


USE = """\
import sys
from router.errors import StartError
from router.ros.types import usable_class

try:
    print(usable_class("nasty/msg/Inner", {"nasty/msg/Inner": (("name", "string"), ("value", sys.argv[1]))}).__name__)
except StartError as error:
    print(error.what)
"""


@pytest.mark.skipif(not is_buildable(), reason="needs the generators of rosidl")
@pytest.mark.parametrize(
    ("python", "table", "told"),
    [
        ("double", "double", "Inner"),
        ("float", "double", "field 2 is 'float value' in {package}, 'double value' in"),
        ("float", "float", "the package 'nasty' is installed twice: {package} is used with {library}"),
    ],
)
def test_a_package_that_two_workspaces_have_is_used_only_if_both_are_like_the_table(
    tmp_path: Path, python: str, table: str, told: str
) -> None:
    """The Python package comes from one of them, the C library from the other."""
    install = built()
    [original] = install.glob("lib/python3.*/site-packages/nasty")
    package = tmp_path / original.relative_to(install)
    shutil.copytree(original, package)
    inner = package / "msg" / "_inner.py"
    inner.write_text(inner.read_text().replace("'value': 'double'", f"'value': '{python}'"))
    variables = environment(install)
    variables["PYTHONPATH"] = f"{package.parent}:{variables['PYTHONPATH']}"
    said = subprocess.check_output([sys.executable, "-c", USE, table], env=variables, text=True)
    assert told.format(package=package, library=install / "lib/libnasty__rosidl_generator_c.so") in said


def test_a_request_without_fields_has_none() -> None:
    assert installed_type("lifecycle_msgs/srv/GetState_Request").fields == ()


@pytest.mark.parametrize(
    ("index", "expected"),
    [
        (BasicType("boolean"), Bool()),
        (BasicType("octet"), Int(8, signed=False, octet=True)),
        (BasicType("uint8"), Int(8, signed=False)),
        (BasicType("int64"), Int(64, signed=True)),
        (BasicType("float"), Float(32)),
        (BasicType("double"), Float(64)),
        (UnboundedString(), String()),
        (BoundedString(5), String(5)),
        (UnboundedWString(), String(wide=True)),
        (BoundedWString(5), String(5, wide=True)),
        (Array(BasicType("double"), 36), List(Float(64), length=36)),
        (UnboundedSequence(BoundedString(3)), List(String(3))),
        (BoundedSequence(UnboundedWString(), 4), List(String(wide=True), bound=4)),
    ],
)
def test_every_kind_of_slot_is_known(monkeypatch: pytest.MonkeyPatch, index: object, expected: Type) -> None:
    monkeypatch.setattr(ros_types, "installed_class", lambda _: generated(it=index))
    assert shape(installed_type("made_msgs/msg/Made")) == ("made_msgs/msg/Made", [("it", shape(expected))])


def test_types_in_an_action_keep_their_namespace_and_are_one_each(monkeypatch: pytest.MonkeyPatch) -> None:
    inner = NamespacedType(["made_msgs", "action"], "Wait_Feedback")
    classes = {
        "made_msgs/action/Wait_FeedbackMessage": generated(one=inner, many=UnboundedSequence(inner)),
        "made_msgs/action/Wait_Feedback": generated(left=BasicType("float")),
    }
    monkeypatch.setattr(ros_types, "installed_class", classes.__getitem__)
    one, many = installed_type("made_msgs/action/Wait_FeedbackMessage").fields
    assert shape(one.type) == ("made_msgs/action/Wait_Feedback", [("left", Float(32))])
    assert isinstance(many.type, List)
    assert many.type.element is one.type


@pytest.mark.parametrize("unknown", ["wchar", "long double", "char"])
def test_a_type_that_only_idl_has_is_refused_with_its_place(monkeypatch: pytest.MonkeyPatch, unknown: str) -> None:
    index = UnboundedSequence(BasicType(unknown))
    monkeypatch.setattr(ros_types, "installed_class", lambda _: generated(it=index))
    with pytest.raises(StartError, match=f"^made_msgs/msg/Made.it is a {unknown}, which the router cannot read"):
        installed_type("made_msgs/msg/Made")
