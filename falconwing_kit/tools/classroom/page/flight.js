// The log of one flight and the hall it was flown in -> the player, on a page of its own.

import { AfterFlight } from "./after.js";
import { Channel } from "./channel.js";
import { byId, showConnection } from "./parts.js";

/** The page of `falconwing replay`. */
class FlightPage {
  constructor() {
    this.channel = new Channel("wall");
    const rate = Number(new URLSearchParams(location.search).get("speed")) || 1;
    this.after = new AfterFlight(byId("flight"), this.channel, { onclose: null, rate });
    this.opened = false;
    showConnection(byId("connection"), this.channel);
    this.channel.on("hello", (hello) => {
      if (hello.scene_url) this.open();
    });
    this.channel.on("preparing", (message) => {
      if (message.share >= 1) this.open(); // without a hall where there is none
      else byId("preparing").textContent = `${message.text[0].toUpperCase()}${message.text.slice(1)}.`;
    });
  }

  open() {
    if (this.opened) return;
    this.opened = true;
    byId("preparing").hidden = true;
    this.after.open(1);
  }
}

globalThis.classroomPage = new FlightPage();
