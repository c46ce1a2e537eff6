//! Robot modules, one lesson a file.
