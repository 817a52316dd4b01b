"""What all formats share: specs and their registry, losses, diagnostics, outputs, files, images, tables of text."""
