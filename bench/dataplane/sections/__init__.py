"""What is measured: a module for each section, each with a `measure(context)`."""
