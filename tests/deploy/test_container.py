"""deploy/container, as far as it can be checked where no container runs."""

from __future__ import annotations

import errno
import os
import re
import shutil
import subprocess
import sys
from grp import getgrnam
from pathlib import Path
from resource import RLIMIT_NOFILE, getrlimit
from typing import Any

import pytest
import yaml

from router.carrier.build import compile_c
from router.compiler import check_table
from tests.deploy.prometheus_server import OF_GATEWAYS, SCRAPED
from tests.tables import ROUTES

ROOT = Path(__file__).parent.parent.parent
FOLDER = ROOT / "deploy/container"
DOCKERFILE = (FOLDER / "Dockerfile").read_text()
COMPOSE = yaml.safe_load((FOLDER / "compose.yaml").read_text())
HADOLINT = shutil.which("hadolint", path=f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin")


@pytest.mark.skipif(HADOLINT is None, reason="hadolint is not installed")
def test_hadolint_has_nothing_to_say() -> None:
    assert HADOLINT
    told = subprocess.run([HADOLINT, FOLDER / "Dockerfile"], stdout=subprocess.PIPE, text=True, check=False)
    assert told.stdout == ""
    assert told.returncode == 0


def test_what_is_copied_exists_and_reaches_the_build() -> None:
    copied = [words.split()[:-1] for words in re.findall(r"^COPY (?!--from)(.+)$", DOCKERFILE, re.MULTILINE)]
    files = [file for files in copied for file in files]
    allowed = [line[1:] for line in (FOLDER / "Dockerfile.dockerignore").read_text().splitlines() if line[:1] == "!"]
    assert files
    for file in files:
        assert (ROOT / file).exists()
        assert any(Path(file).is_relative_to(folder) for folder in allowed)
    assert all(any(Path(file).is_relative_to(folder) for file in files) for folder in allowed)


def test_router_in_the_container_is_a_program_that_bash_can_read() -> None:
    bash = shutil.which("bash")
    assert bash
    entry = FOLDER / "router.sh"
    assert entry.stat().st_mode & 0o111 == 0o111
    assert subprocess.run([bash, "-n", entry], check=False).returncode == 0
    assert f"COPY deploy/container/{entry.name} /opt/rover_router/bin/router\n" in DOCKERFILE


def test_health_is_asked_where_the_rovers_table_serves_it() -> None:
    table = check_table(ROUTES / "rover.yaml").table
    assert table is not None
    assert table.http is not None
    host, _, port = SCRAPED.rpartition(":")
    assert table.http.address.value.host in (host, "0.0.0.0")
    assert table.http.address.value.port == int(port)
    assert f"ROUTER_METRICS={SCRAPED}\n" in DOCKERFILE
    [command] = re.findall(r"^ +CMD (\[.+\])$", DOCKERFILE, re.MULTILINE)
    interpreter, option, code = yaml.safe_load(command)
    assert (interpreter, option) == ("python3", "-c")
    compile(code, "HEALTHCHECK", "exec")
    assert "/ready" in code


def test_gateways_are_a_service_of_another_user_with_a_health_check_of_their_own() -> None:
    router, gateways = (COMPOSE["services"][name] for name in ("router", "gateways"))
    assert f"ROUTER_METRICS={OF_GATEWAYS}" in gateways["environment"]
    assert gateways["image"] == router["image"]
    assert gateways["user"] not in re.findall("^USER (.+)$", DOCKERFILE, re.MULTILINE)
    assert not any("state" in mounted or "recordings" in mounted for mounted in gateways["volumes"])
    domain = {"ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"}
    assert domain < {*router["environment"]}
    assert domain < {*gateways["environment"]}


@pytest.mark.parametrize("name", COMPOSE["services"])
def test_a_service_uses_the_hosts_network_and_mounts_what_there_is(name: str) -> None:
    service = COMPOSE["services"][name]
    assert service["network_mode"] == "host"
    assert "ports" not in service
    for mounted in service["volumes"]:
        source = mounted.split(":")[0]
        assert (FOLDER / source).exists() if source.startswith(".") else source in COMPOSE["volumes"]
    of_build = service["image"] == COMPOSE["services"]["router"]["image"]
    assert of_build or re.fullmatch(r"\$\{[A-Z]+_IMAGE:-\S+:v?\d+\.\d+\.\d+\}", service["image"])
    assert (service["read_only"], service["cap_drop"]) == (True, ["ALL"])
    assert service["security_opt"] == ["no-new-privileges:true"]


def test_compose_builds_this_dockerfile_in_the_root_of_the_checkout() -> None:
    build = COMPOSE["services"]["router"]["build"]
    assert (FOLDER / build["context"]).resolve() == ROOT
    assert ROOT / build["dockerfile"] == FOLDER / "Dockerfile"


SERIAL = yaml.safe_load((FOLDER / "serial.yaml").read_text())["services"]
OPEN = """
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <unistd.h>

int main(int count, char **names) {
    if (count < 2) pause();
    for (char **name = names + 1; *name; name++)
        printf("%d ", open(*name, O_RDWR | O_NOCTTY | O_NONBLOCK) < 0 ? errno : 0);
}
"""
"""Prints the error of opening each device, 0 for none. Without devices, it waits."""

RUN = r"""
set -e
! mountpoint -q /sys/fs/cgroup/unified || umount /sys/fs/cgroup/unified  # podman does not support hybrid cgroups
trap 'podman rm --force --time 0 "$2" > /dev/null; podman rmi "$2" > /dev/null; rm -f /dev/$2-*' EXIT
tar -C "$1" --mode 755 -c open | podman import --quiet - "$2" > /dev/null
podman run --detach --name "$2" --network host --cap-drop ALL --security-opt no-new-privileges --read-only \
  --user 1000:1000 "${@:3}" "$2" /open > /dev/null
for number in 166 188 204 4; do
  mknod -m 660 "/dev/$2-$number" c $number 250
  chgrp dialout "/dev/$2-$number"
done
mknod -m 600 "/dev/$2-root" c 166 251
podman exec "$2" /open /dev/null "/dev/$2-"{166,188,204,4,root}
"""
"""Arguments: the folder of the program, a name for image, container and devices, and options of the container."""


def test_serial_lines_add_to_the_router_only_devices_and_the_group_of_this_computer() -> None:
    [added] = SERIAL.values()
    assert list(SERIAL) == ["router"]
    assert set(added) == {"volumes", "device_cgroup_rules", "group_add"}
    assert added["group_add"] == [str(getgrnam("dialout").gr_gid)]


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("podman") is None, reason="needs root and podman")
def test_the_router_can_open_serial_devices_that_are_plugged_in_later_and_no_others(tmp_path: Path) -> None:
    (tmp_path / "open.c").write_text(OPEN)
    compile_c(["-static", "-o", str(tmp_path / "open"), str(tmp_path / "open.c")])
    files = getrlimit(RLIMIT_NOFILE)[1]  # podman cannot raise limits inside a container
    (tmp_path / "containers.conf").write_text(
        f'[containers]\ndefault_ulimits = ["nofile={files}:{files}", "nproc=4096:4096"]\n'
        '[engine]\ncgroup_manager = "cgroupfs"\n'
    )
    router = SERIAL["router"]
    options = [f"--volume={each}" for each in router["volumes"]]
    options += [f"--device-cgroup-rule={each}" for each in router["device_cgroup_rules"]]
    options += [f"--group-add={each}" for each in router["group_add"]]
    command = ["unshare", "--mount", "bash", "-c", RUN, "run", str(tmp_path), f"router-test-{os.getpid()}", *options]
    found = subprocess.run(
        command,
        env={**os.environ, "CONTAINERS_CONF": str(tmp_path / "containers.conf")},
        capture_output=True,
        text=True,
        check=False,
    )
    no_driver = str(errno.ENXIO)  # as for no other reason: the container may open it
    opened = ["0", no_driver, no_driver, no_driver, str(errno.EPERM), str(errno.EACCES)]
    assert (found.stdout.split(), found.stderr) == (opened, "")


def test_all_images_can_be_pinned_and_pinned_again(tmp_path: Path) -> None:
    for name in ("compose.yaml", "pin.sh"):
        shutil.copy(FOLDER / name, tmp_path)
    docker = tmp_path / "docker"
    (tmp_path / ".env").write_text("BASESTATION=10.0.0.2:9000\n")
    for digest in ("sha256:old", "sha256:new"):
        docker.write_text(f'#!/bin/sh\n[ "$1 $2 $3" = "buildx imagetools inspect" ] && echo {digest}\n')
        docker.chmod(0o755)
        environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
        subprocess.run([tmp_path / "pin.sh"], env=environment, check=True)
    assert (tmp_path / ".env").read_text().splitlines() == [
        "BASESTATION=10.0.0.2:9000",
        "ROS_IMAGE=ros:jazzy-ros-base@sha256:new",
        "PROMETHEUS_IMAGE=prom/prometheus:v3.5.0@sha256:new",
        "GRAFANA_IMAGE=grafana/grafana:12.1.0@sha256:new",
    ]
    used = re.findall(r"^FROM (\S+)", DOCKERFILE, re.MULTILINE)
    assert used == ["${ROS_IMAGE}"] * 2


def test_grafana_is_provisioned_with_our_prometheus_and_our_dashboard() -> None:
    provisioning = ROOT / "deploy/grafana/provisioning"
    [source] = _provisioned(provisioning / "datasources/prometheus.yml")["datasources"]
    [provider] = _provisioned(provisioning / "dashboards/rover.yml")["providers"]
    listening = COMPOSE["services"]["prometheus"]["command"][-1]
    assert source["type"] == "prometheus"
    assert listening == f"--web.listen-address={source['url'].removeprefix('http://')}"
    grafana = COMPOSE["services"]["grafana"]
    home = f"{provider['options']['path']}/rover-router.json"
    assert grafana["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"] == home
    assert f"../grafana/rover-router.json:{home}:ro" in grafana["volumes"]
    assert "../grafana/provisioning:/etc/grafana/provisioning:ro" in grafana["volumes"]


def test_nobody_can_log_in_to_change_things() -> None:
    environment = COMPOSE["services"]["grafana"]["environment"]
    assert environment["GF_AUTH_ANONYMOUS_ORG_ROLE"] == "Viewer"
    assert environment["GF_SECURITY_DISABLE_INITIAL_ADMIN_CREATION"] == "true"
    assert environment["GF_AUTH_BASIC_ENABLED"] == "false"


def _provisioned(file: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(file.read_text())
    assert found["apiVersion"] == 1
    return found
