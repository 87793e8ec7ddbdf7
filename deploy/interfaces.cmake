# Limits what `make setup` builds of an interface package to what Python and C programs load, with any middleware. It
# leaves out the C++ code that other nodes need, and compiles several files at once: this takes a third of the time.
#
#   cmake -DCMAKE_PROJECT_comms_INCLUDE=.../deploy/interfaces.cmake -S schemas/comms ...
#
# In a workspace colcon does not use this file and builds everything.
find_package(rosidl_default_generators REQUIRED)
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces INCLUDE REGEX "_(c|py|type_description):")

set(CMAKE_UNITY_BUILD ON)
# But not here: each file describes its message under the same names.
cmake_language(DEFER CALL set_target_properties ${PROJECT_NAME}__rosidl_generator_c PROPERTIES UNITY_BUILD OFF)
