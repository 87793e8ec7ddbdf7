"""Values of fields as people write and read them: `reading` parses, `printing` formats."""
