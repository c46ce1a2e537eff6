mod sync {
    #[blastema::main]
    fn main() {}
}

mod arguments {
    #[blastema::main]
    async fn main(arguments: Vec<String>) {}
}

mod keys {
    #[blastema::main(threads = 4)]
    async fn main() {}
}

fn main() {}
