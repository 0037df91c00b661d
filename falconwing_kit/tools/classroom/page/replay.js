// The number of a flight -> that flight in a dialog over the page; the player's modules are fetched only then.

/** A dialog for flights; the live hall behind it is not drawn meanwhile. */
export class Replay {
  constructor(dialog, channel, view, { modal = true } = {}) {
    this.modal = modal; // else the page around it stays at hand
    this.dialog = dialog;
    this.channel = channel;
    this.view = view;
    this.box = dialog.querySelector(".replay-box");
    this.after = null;
    this.scene = null;
    channel.on("hello", (hello) => {
      this.scene = hello.scene_url;
    });
    dialog.addEventListener("close", () => this.closed());
  }

  async open(number) {
    if (this.dialog.open) return;
    if (this.modal) this.dialog.showModal();
    else this.dialog.show();
    this.view.suspend(true);
    try {
      if (!this.after) {
        const { AfterFlight } = await import("./after.js");
        const onclose = () => this.close();
        this.after = new AfterFlight(this.box, this.channel, { sceneUrl: this.scene, onclose });
      }
      await this.after.open(number);
    } catch (error) {
      this.box.hidden = false;
      this.box.textContent = `The flight cannot be shown: ${error.message}. Press Escape to go back.`;
    }
  }

  close() {
    if (this.dialog.open) this.dialog.close();
  }

  closed() {
    this.view.suspend(false);
    if (this.after) this.after.close(false);
  }
}
