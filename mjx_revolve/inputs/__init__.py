"""What users give and what is written for them: errors, YAML, command lines, own code, files."""
