"""What `nebula verify` measures, attributes, draws and writes."""
