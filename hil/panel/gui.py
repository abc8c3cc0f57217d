"""What the parts of a page have in common."""

from typing import Any

import viser

from hil.look import LIGHT, rgb

_SHOWN_S = 8.0


def set_theme(gui: viser.GuiApi) -> None:
    """Give a page the accent of reports, and its controls their place."""
    accent = rgb(LIGHT["accent"])
    gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False, brand_color=accent)
    gui.main_panel.dock_right()


def set_text(handle: Any, text: str) -> None:
    """Change a text, if it is another one."""
    if handle.content != text:
        handle.content = text


def tell_not_done(server: viser.ViserServer, client: Any, why: str) -> None:
    """Tell a browser, if it is there, why something that it wanted is not done."""
    if client.client_id in server.get_clients():
        client.add_notification("Not done", why, color="red", auto_close_seconds=_SHOWN_S)
