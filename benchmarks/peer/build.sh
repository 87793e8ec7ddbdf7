#!/usr/bin/env bash
# usage: build.sh OUT_DIR PREFIX...
#
# OUT_DIR  gets load, sink, bare_forward, cpp_peer, ros_load and, where its libraries are installed, gateway_peer
# PREFIX   where ROS packages are installed, the interfaces of schemas/comms among them
#
# `python -m benchmarks.versus` calls it and knows what it needs. The protoc has to be the system's: what the one in
# grpcio-tools generates is too new for the system's protobuf headers.
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
out=$1
shift

for program in load sink bare_forward; do
  gcc -O2 -Wall -Wextra -std=gnu11 "$here/$program.c" -o "$out/$program"
done

generated=$out/generated
rm -rf "$generated"
mkdir -p "$generated"
cd "$here/../../tests/rover/protos"
find . -name '*.proto' -printf '%P\n' | xargs /usr/bin/protoc -I . --cpp_out="$generated"
# In one piece, so that protobuf's headers are read once; each file has statics of these names.
cd "$generated"
number=0
while read -r file; do
  number=$((number + 1))
  for name in schemas file_default_instances; do printf '#undef %s\n#define %s %s_%s\n' $name $name $name $number; done
  printf '#include "%s"\n' "$file"
done < <(find . -name '*.pb.cc' | sort) >envelope.cc

options=()
for prefix; do
  for directory in "$prefix"/include/*/; do options+=("-I$directory"); done
  options+=("-L$prefix/lib")
done
g++ -O2 -DNDEBUG -std=c++17 -I. -c envelope.cc
g++ -O2 -DNDEBUG -std=c++17 -Wall -Wextra -rdynamic "-I$here" -I. "${options[@]}" "$here/cpp_peer.cpp" envelope.o \
  -lcomms__rosidl_typesupport_c -lcomms__rosidl_generator_c -lrcl -lrmw -lrcutils -lrosidl_runtime_c \
  -lprotobuf -lpthread -Wl,--allow-shlib-undefined -o "$out/cpp_peer"

gcc -O2 -Wall -Wextra -std=gnu11 -rdynamic "-I$here" "${options[@]}" "$here/ros_load.c" \
  -lrcl -lrmw -lrcutils -lrosidl_runtime_c -Wl,--allow-shlib-undefined -o "$out/ros_load"

# Only `python -m benchmarks.gateway` and tests/gateway/golden/capture.py want this one.
rm -f "$out/gateway_peer"
missing=()
[ -f /usr/include/nlohmann/json.hpp ] || missing+=(nlohmann-json3-dev)
[ -f /usr/include/zstd.h ] || missing+=(libzstd-dev)
if [ ${#missing[@]} -gt 0 ]; then
  printf 'gateway_peer is left out; on Debian or Ubuntu: apt-get install %s\n' "${missing[*]}" >&2
  exit 0
fi
middleware=rmw_fastrtps_cpp  # the wheels have no rmw_implementation, which would choose one
for prefix; do
  if [ -f "$prefix/lib/librmw_implementation.so" ]; then middleware=rmw_implementation; fi
done
g++ -O2 -DNDEBUG -std=c++17 -Wall -Wextra -rdynamic "-I$here" "${options[@]}" "$here/gateway_peer.cpp" \
  -lrcl -lrmw "-l$middleware" -lrcutils -lrcpputils -lament_index_cpp -lrosidl_runtime_c -lzstd -lpthread \
  -Wl,--allow-shlib-undefined -o "$out/gateway_peer"
