"""What a trained model can be run on: recordings of any kind, read as samples."""
