"""The TriFinger robot: scene, controller, physics, rendering and tasks. Import the module you need."""
