"""Draws a Scene with Cycles, in a child process. The only importer of bpy."""
