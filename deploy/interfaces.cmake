# What `make setup` builds of an interface package: what Python and C programs load, with any middleware. It leaves out
# the C++ of other nodes and compiles several files at once, which takes a third of the time.
#
#   cmake -DCMAKE_PROJECT_comms_INCLUDE=.../deploy/interfaces.cmake -S schemas/comms ...
#
# In a workspace colcon builds the package without this file, and so everything.
find_package(rosidl_default_generators REQUIRED)
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces INCLUDE REGEX "_(c|py|type_description):")

set(CMAKE_UNITY_BUILD ON)
# But not where each file uses the same names for the description of its message.
cmake_language(DEFER CALL set_target_properties ${PROJECT_NAME}__rosidl_generator_c PROPERTIES UNITY_BUILD OFF)
