// A verdict of the class -> the flight on the same page: player, what is missing, file to share, log.

import { Player } from "./player.js";
import { SplatView } from "./splats.js";

const AFTER_STYLE = "/page/player.css";

/**
 * What is shown after a flight, inside `box`. `open(number)` shows a flight, `close()` goes back;
 * `channel` (with `on(type, function)` and `send(message)`) carries the question what is missing.
 */
export class AfterFlight {
  constructor(box, channel = null, { sceneUrl = null, onclose = () => {}, rate = 1 } = {}) {
    this.box = box;
    this.channel = channel;
    this.sceneUrl = sceneUrl;
    this.onclose = onclose;
    this.rate = rate; // of time, at first
    this.player = null;
    this.number = 0;
    this.answers = new Map(); // what `gap` said about a flight
    box.hidden = true;
    if (channel) {
      channel.on("hello", (hello) => {
        this.sceneUrl = hello.scene_url || this.sceneUrl;
      });
      channel.on("gap", (answer) => this.takeAnswer(answer));
    }
    if (!document.querySelector(`link[href="${AFTER_STYLE}"]`)) {
      const link = document.createElement("link");
      Object.assign(link, { rel: "stylesheet", href: AFTER_STYLE });
      document.head.append(link);
    }
  }

  /** Show flight `number`; a sentence stands there where it cannot be shown. */
  async open(number) {
    this.close(false);
    this.number = number;
    this.box.hidden = false;
    this.box.dataset.flight = String(number);
    const wait = afterElement("p", "fw-note-plain", "Flying the log again for its verdict \u2026");
    this.box.replaceChildren(this.closeButton(), wait);
    try {
      const answer = await fetch(`/flights/${number}.json`, { cache: "no-store" });
      if (!answer.ok) throw new Error(`the server answered ${answer.status}`);
      const data = await answer.json();
      if (this.number !== number) return; // another flight was opened meanwhile
      await this.show(data);
    } catch (error) {
      wait.textContent = `Flight ${number} cannot be shown (${error.message}).`;
    }
  }

  async show(data) {
    const canvas = document.createElement("canvas");
    let view = null;
    let why = "This browser has no WebGL2: the flight is drawn as a map.";
    if (this.sceneUrl && SplatView.supported()) {
      try {
        view = new SplatView(canvas, { background: "#1b222b" });
        why = "Loading the hall \u2026";
      } catch (error) {
        why = `The hall cannot be drawn here (${error.message}): the flight is drawn as a map.`;
      }
    }
    const place = afterElement("div");
    this.box.replaceChildren(this.closeButton(), place, this.links(data));
    this.player = new Player(place, data, view, view ? canvas : null);
    this.player.rate = this.rate;
    this.player.say(why);
    this.showAnswer();
    this.player.play();
    if (!view) return;
    const { player } = this;
    try {
      await view.load(this.sceneUrl, () => {});
      player.say("");
    } catch (error) {
      player.say(`The hall cannot be drawn here (${error.message}): the flight is drawn as a map.`);
      player.chooseCamera("map");
    }
    player.touch();
  }

  /** Go back to what flies now. */
  close(tell = true) {
    if (this.player) this.player.dispose();
    this.player = null;
    this.number = 0;
    this.box.replaceChildren();
    this.box.hidden = true;
    if (tell && this.onclose) this.onclose();
  }

  /** The way back to the page's own view, where there is one. */
  closeButton() {
    if (!this.onclose) return document.createDocumentFragment();
    const row = afterElement("p", "fw-after-links");
    const button = afterElement("button", "", "Back to what flies now");
    button.type = "button";
    button.addEventListener("click", () => this.close());
    row.append(button);
    return row;
  }

  links(data) {
    const row = afterElement("div", "fw-after-links");
    if (this.channel) {
      this.gapButton = afterElement("button", "", "Name what is missing");
      this.gapButton.type = "button";
      this.gapButton.addEventListener("click", () => this.ask());
      row.append(this.gapButton);
    }
    const file = afterElement("a", "", "Share: one file");
    Object.assign(file, { href: `/flights/${data.number}.html`, download: `flight_${data.number}.html` });
    const log = afterElement("a", "", "Log (MCAP)");
    Object.assign(log, { href: `/flights/${data.number}.mcap`, download: `flight_${data.number}.mcap` });
    this.gapText = afterElement("p", "fw-gap");
    this.gapText.setAttribute("role", "status");
    row.append(file, log, this.gapText);
    return row;
  }

  ask() {
    this.answers.set(this.number, { state: "running", sentence: "Comparing with a calm flight \u2026" });
    this.channel.send({ type: "gap", flight: this.number });
    this.showAnswer();
  }

  takeAnswer(answer) {
    this.answers.set(answer.flight, answer);
    this.showAnswer();
  }

  showAnswer() {
    const answer = this.answers.get(this.number);
    if (!answer || !this.gapText) return;
    this.gapText.textContent = answer.sentence;
    this.gapText.dataset.state = answer.state;
    if (this.gapButton) this.gapButton.disabled = answer.state === "running";
  }
}

/** A new element; text is never read as HTML. */
export function afterElement(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}
