"""From files to clean meshes and tables of subjects (5, the data)."""
