# shellcheck shell=bash disable=SC2034
# To be sourced: finds the interpreters on this computer that the router supports.

supported_pythons=(3.10 3.11 3.12 3.13)

find_python() {  # VERSION: print the path of such an interpreter, on PATH or from pyenv; fail if there is none
  local candidate
  for candidate in "$(command -v "python$1")" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python; do
    if "$candidate" -c "import sys; sys.exit('%d.%d' % sys.version_info[:2] != '$1')" 2>/dev/null; then
      printf '%s' "$candidate"
      return
    fi
  done
  return 1
}
