# Lets a ROS package build against ROS wheels in a virtual environment (use: CMAKE_PROJECT_INCLUDE).
#
# Some targets that the wheels export name the Python headers of the machine that built them. CMake refuses an
# include directory that does not exist, so such directories are replaced by this interpreter's own headers.
# The call is deferred: it must see the targets that the package's CMakeLists.txt has found.

find_package(Python3 REQUIRED COMPONENTS Interpreter Development.Module)

function(plr_repair_imported_includes)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(directories "${target}" INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT directories)
      continue()
    endif()
    set(repaired "")
    foreach(directory IN LISTS directories)
      if(NOT IS_ABSOLUTE "${directory}" OR EXISTS "${directory}")
        list(APPEND repaired "${directory}")
      else()
        list(APPEND repaired ${Python3_INCLUDE_DIRS})
      endif()
    endforeach()
    list(REMOVE_DUPLICATES repaired)
    set_target_properties("${target}" PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${repaired}")
  endforeach()
endfunction()

cmake_language(DEFER CALL plr_repair_imported_includes)
