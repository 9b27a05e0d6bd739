"""Files, pictures, and fields for PyVista."""
